"""``oracle compare``: names the stage in which another renderer differs from the reference."""

import argparse

from minisplat_ref.app.cli.oracle import CALLS, add_call_argument, add_output_arguments, module_of, publish
from minisplat_ref.constants import PROFILES
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import Commands, HelpFormatter
from minisplat_ref.interface.progress import with_progress

DESCRIPTION = """\
Compare a renderer with the float64 reference, stage by stage, and name the
first stage that differs. The stages are projection, tile lists, colours,
compositing, losses, further channels and depths, blend statistics, surface
points and Adam; then the gradients from the image back to the scene; and last
the whole view, by one call.

BACKEND is one of

  MODULE:FUNCTION any function with the signature of gsplat's rasterization, on
                  NumPy, torch or JAX arrays; gradients by FUNCTION_vjp beside
                  it, else by torch or JAX
  DIR             a folder of arrays that your own renderer has written, in the
                  format of oracle export; the README.md in there explains it
  cpu, cpu-exact, reference
                  ours
  cuda, cuda-atomic
                  ours on an NVIDIA GPU, in float32
  gsplat-torch    gsplat's functions in plain PyTorch, on the CPU
  gsplat, inria   gsplat's kernels, and the rasteriser of the 3DGS paper, where
                  they are installed and there is a CUDA device
  profile:NAME    the reference by the conventions of another renderer: what a
                  difference in conventions looks like
  planted:ERROR   ours with one error in it, to see how that is reported

Ours, gsplat-torch and gsplat are given the reference's own input at every
stage, so that an error stays where it arose. With the others, and in the view,
a later difference may follow from the first, and is marked so.

A pixel in which rounding decides a hit (alpha within 1e-6 of 1/255, the
transmittance as near to the stop threshold, or two depths that float32 cannot
tell apart) is a candidate for a flip: its error is counted, neither failed nor
averaged in. In the scenes of equality nothing is set aside: values equal their
thresholds in binary, and in float64 nothing rounds. (Ours are left out there in
float32.) Boxes and tile lists that differ without changing the image are
harmless.

Where something diverges, up to three planted faults are named that would explain
it, or come nearest, and what else to return to tell them apart.
"""
EPILOG = """\
columns: largest and RMS error; the largest as a part of the largest value of
the array, and its limit; how many values exceed that, and of how many; flips,
and the candidates for them. For radii and tile lists, rows and tiles that
differ. Every stage is reported in the scene where it is furthest off.

examples:
  minisplat-ref oracle compare my_package.my_module:rasterization
  minisplat-ref oracle compare cpu --dtype float32
  minisplat-ref oracle compare planted:half-off-diagonal --scene ordinary
  minisplat-ref oracle compare profile:INRIA --scene sh3 --json differences.json

of surfels, and of lenses, fisheyes and parallel rays, on scenes of their own:
  minisplat-ref oracle compare my_module:my_function --call rasterization_2dgs
  minisplat-ref oracle compare gsplat:rasterization --call rasterization_cameras

your own renderer, in three lines:
  minisplat-ref oracle export golden
  YOUR_PROGRAM golden mine      # reads golden/SCENE/*.npz, writes mine/SCENE/*.npz
  minisplat-ref oracle compare mine

Exit codes: 0 every stage that was given agrees, 1 one diverges, 2 bad input."""
SCENES = (  # as in oracle.golden.scenes
    *("ordinary", "antialiased", "inria", "off-centre", "sh3", "odd-size"),
    *("planes", "equality", "equality-inria"),
)


def add_parser(checks: Commands) -> None:
    """Add the check."""
    parser = checks.add_parser(
        "compare",
        help="name the first stage in which another renderer differs",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("backend", metavar="BACKEND", help="a function, a renderer's name, or a folder of arrays")
    parser.add_argument("--scene", default="all", metavar="NAME", help=f"{', '.join(SCENES)}, or all (default)")
    parser.add_argument(
        "--against",
        default="reference",
        metavar="WHAT",
        help="reference, computed now (default), or a folder that oracle export wrote",
    )
    parser.add_argument(
        "--profile",
        type=str.upper,
        choices=tuple(PROFILES),
        metavar="NAME",
        help=f"conventions for every scene, in place of its own; of a function: its rules: {', '.join(PROFILES)}",
    )
    parser.add_argument(
        "--dtype",
        choices=("float32", "float64"),
        metavar="TYPE",
        help="float32 or float64: what is computed in, and so the tolerances (default: float64 for ours and"
        " gsplat-torch, float32 for a function, that of each array for a folder)",
    )
    parser.add_argument(
        "--arrays",
        choices=("numpy", "torch", "jax"),
        metavar="KIND",
        help="what a function is called with: numpy, torch or jax (default: what its module imports)",
    )
    add_call_argument(parser)
    add_output_arguments(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Compare every scene, print the table of stages."""
    if args.call in CALLS:
        return _compare_call(args)
    from minisplat_ref.oracle.comparison.renderers import choose_function, choose_renderer, choose_scenes, is_function
    from minisplat_ref.oracle.comparison.staged import as_report, compare_scene

    if is_function(args.backend):
        renderer = choose_function(args.backend, args.dtype, args.profile, args.arrays)
        scenes, left_out = choose_scenes(renderer, args.scene, args.against, None)
    elif args.arrays is not None:
        raise InputError(f"--arrays is for a function, and {args.backend} is none: leave it out")
    else:
        renderer = choose_renderer(args.backend, args.dtype)
        scenes, left_out = choose_scenes(renderer, args.scene, args.against, args.profile)
    compared = with_progress(scenes.values(), "comparing", "scenes")
    rows = [row for scene in compared for row in compare_scene(renderer, scene)]
    settings = {
        "against": args.against,
        "conventions": {name: scene.conventions.name for name, scene in scenes.items()},
        "left_out": list(left_out),
    }
    report = as_report(renderer, rows, settings)
    code = publish(report, args)
    for line in report.settings["looks_like"]:
        print(line)
    if report.settings["not_given"]:
        print(f"not given: {', '.join(report.settings['not_given'])}")
    if left_out:
        print(f"left out, since {renderer.name} follows other conventions or rounds: {', '.join(left_out)}")
    return code


def _compare_call(args: argparse.Namespace) -> int:
    """Do the same for another call of gsplat's, and name the first stage that differs."""
    from minisplat_ref.oracle.call_comparison import choose_renderer, compare, truth

    if args.against != "reference":
        raise InputError(f"{args.call} is compared with the reference: leave --against out")
    call = module_of(args.call, "call").CALL
    known = {scene.name: scene for scene in call.scenes()}
    if args.scene not in ("all", *known):
        raise InputError(f"scene {args.scene!r} is unknown; choose all or one of {', '.join(known)}")
    renderer = choose_renderer(call, args.backend, args.dtype, args.arrays)
    chosen = known if args.scene == "all" else {args.scene: known[args.scene]}
    known_arrays = {name: (scene, truth(call, scene, args.profile)) for name, scene in chosen.items()}
    report = compare(call, renderer, known_arrays)
    code = publish(report, args)
    if report.settings["first_difference"] is not None:
        print(f"first difference: {report.settings['first_difference']}")
    if report.settings["not_given"]:
        print(f"not given: {', '.join(report.settings['not_given'])}")
    return code
