"""The studies ``rays/claims`` and ``rays/speed``."""

import argparse

from minisplat_ref.extensions.shared_studies import add_out, check_at_least, write
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.reporting import markdown_table
from minisplat_ref.studies.study import Study


def add_claims_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--out``, ``--gaussians`` and ``--seed``."""
    add_out(parser)
    parser.add_argument("--gaussians", type=int, default=300, metavar="N", help="Gaussians per scene (default 300)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="seed of the scenes (default 0)")


def run_claims(args: argparse.Namespace) -> None:
    """Measure each claim, draw the scene, write the results, and print a table.

    Raises
    ------
    InputError
        There is nothing to measure, or the output folder cannot be used.
    """
    from minisplat_ref.extensions.rays import claims

    check_at_least(1, gaussians=args.gaussians)
    with making_folder(args.out) as folder:
        edge, errors = claims.shadow_edge(), claims.splatting_errors()
        result = {
            "tree against brute force": claims.tree_against_brute_force(args.gaussians, args.seed),
            "tracing against exact order": claims.order_difference(args.gaussians, args.seed),
            "mirror against mirrored camera": claims.mirror_difference(args.gaussians, args.seed),
            "edge of a shadow, pixels": edge["pixels"],
        }
        described = {"gaussians": args.gaussians, "seed": args.seed, **result, "shadow": edge}
        splatting = {"sigmas": list(claims.SIGMAS), "errors": errors}
        write(folder, {**described, "splatting against tracing": splatting}, claims.draw(errors))
    print(markdown_table(["claim", "difference"], [[name, f"{value:.1e}"] for name, value in result.items()]))
    print("\nalpha of one round Gaussian, splatted against traced: mean difference over mean\n")
    rows = [[f"{sigma:g}", *(f"{errors[a][s]:.1%}" for a in errors)] for s, sigma in enumerate(claims.SIGMAS)]
    print(markdown_table(["sigma over distance", *errors], rows))


def add_speed_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--gaussians`` and ``--repeats``."""
    parser.add_argument("--gaussians", type=int, default=10_000, metavar="N", help="number (default 10000)")
    parser.add_argument("--repeats", type=int, default=5, metavar="N", help="timings; the least counts (default 5)")


def run_speed(args: argparse.Namespace) -> None:
    """Time a ray and a rasterised pixel, and print both times with the error of tracing.

    Raises
    ------
    InputError
        There is nothing to time.
    """
    from minisplat_ref.extensions.rays import claims

    check_at_least(1, gaussians=args.gaussians, repeats=args.repeats)
    found = claims.speed(args.gaussians, args.repeats)
    print(markdown_table(["measure", "value"], [[name, f"{value:.3g}"] for name, value in found.items()]))
    tuned, plain = (found["ray forward us"] / found[f"{name} forward us"] for name in ("pixel", "plain pixel"))
    print(f"\nA ray takes {tuned:.1f} times as long as a pixel of the tuned kernels, {plain:.1f} times a plain one.")


STUDIES = (
    Study("claims", "tracing against exact order, mirrors, shadows and splatting", add_claims_arguments, run_claims),
    Study("speed", "time of a ray and of a rasterised pixel", add_speed_arguments, run_speed),
)
"""The studies ``rays/claims`` and ``rays/speed``."""
