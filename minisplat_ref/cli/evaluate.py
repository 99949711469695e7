"""``eval``: measures a run on its test views again."""

import argparse
from pathlib import Path

from minisplat_ref.errors import InputError
from minisplat_ref.experiments.arguments import Commands, HelpFormatter

DESCRIPTION = """\
Measure a run on its test views: PSNR, SSIM and, given the weights of its
network, LPIPS of point_cloud.ply, view by view.

Rewrites DIR/metrics.json and DIR/renders/ (truth | render | error). Renders
are clipped to [0, 1] and not rounded; SSIM has an 11 x 11 window and zero
padding; what stands for all views is the mean of theirs.
"""
EPILOG = """\
LPIPS is null without the weights of VGG16 or AlexNet (net='alex'), which are
not part of this program. Where the package lpips is installed, this makes them:
  python -c "import lpips, numpy
  numpy.savez('vgg.npz', **lpips.LPIPS(net='vgg').state_dict())"
Colours go in from -1 to 1, as its authors say; the evaluation published with
3DGS gives it 0 to 1, so its figures are others.

examples:
  minisplat-ref eval runs/fox
  minisplat-ref eval runs/fox --lpips-weights vgg.npz"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "eval",
        help="measure a run on its test views",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="the --out folder of a training")
    parser.add_argument(
        "--scene",
        type=Path,
        metavar="PATH",
        help="where the photographs are now, if they have moved since the training",
    )
    parser.add_argument(
        "--lpips-weights",
        type=Path,
        metavar="NPZ",
        help="weights of LPIPS (default: those that the training was given)",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Measure, print a table, rewrite the files."""
    from minisplat_ref.experiments import run_folder
    from minisplat_ref.experiments.first_use import warn_if_not_kept
    from minisplat_ref.experiments.notices import warn_of_model
    from minisplat_ref.experiments.scoring import score, summary, to_metrics
    from minisplat_ref.experiments.settings import load, load_lpips, load_model, load_photographs

    settings = load(args.folder)
    if args.scene is not None:
        settings = settings._replace(scene=str(args.scene))
    if args.lpips_weights is not None:
        settings = settings._replace(lpips_weights=str(args.lpips_weights))
    model = load_model(args.folder, settings)
    warn_of_model(model, args.folder)
    warn_if_not_kept(settings.backend)
    scene = load_photographs(settings)
    if not scene.test_views:
        raise InputError(f"{settings.scene} was split without test views (--test-every 0): nothing to measure")
    evaluation = score(args.folder, scene, model, settings, load_lpips(settings, scene))

    path = args.folder / run_folder.METRICS
    metrics = run_folder.read_json_object(path) if path.exists() else {}
    run_folder.write_json(path, {**metrics, **to_metrics(evaluation), "n_gaussians": len(model.gaussians.means)})
    width = max(len(view.name) for view in evaluation.per_view)
    print(f"{'view':<{width}}  PSNR dB    SSIM{'' if evaluation.lpips is None else '   LPIPS'}")
    for view in evaluation.per_view:
        lpips = "" if view.lpips is None else f"  {view.lpips:.4f}"
        print(f"{view.name:<{width}}  {view.psnr:7.2f}  {view.ssim:.4f}{lpips}")
    print(summary(evaluation))
    return 0
