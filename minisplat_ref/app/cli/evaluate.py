"""``eval``: measures a run on its test views again."""

import argparse
import sys
from pathlib import Path

from minisplat_ref.interface.arguments import Commands, HelpFormatter, integer

DESCRIPTION = """\
Measure a run on its test views: PSNR, SSIM and, given the weights of its
network, LPIPS of point_cloud.ply, view by view.

Rewrites DIR/metrics.json and DIR/renders/ (truth | render | error). Everything
but the run's result on its own test views goes into its own folder: other
views of its photographs (--test-every), other Gaussians (--model) and a run
that has not ended into DIR/eval-..., another scene into --out, then required.
Renders are clipped to [0, 1] and not rounded; SSIM has an 11 x 11 window and
zero padding; the figures are means over the views. metrics.json also has the
PSNR with the exposure that the tracks of a view's sparse points show, and that
after the affine map of its colours that fits best; --color-corrected prints
both for each view, too.
"""
EPILOG = """\
LPIPS is null without the weights of VGG16 or AlexNet (net='alex'), which are
not part of this program. If the package lpips is installed, this makes them:
  python -c "import lpips, numpy
  numpy.savez('vgg.npz', **lpips.LPIPS(net='vgg').state_dict())"
Colours go in from -1 to 1, as its authors say; the evaluation published with
3DGS passes 0 to 1, so its figures differ.

examples:
  minisplat-ref eval runs/fox
  minisplat-ref eval runs/fox --lpips-weights vgg.npz
  minisplat-ref eval runs/fox --model fox.msz"""


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
        help="where the photographs are now, if they have moved",
    )
    parser.add_argument("--model", type=Path, metavar="FILE", help="measure these Gaussians: a PLY or a compact file")
    parser.add_argument("--test-every", type=integer(1), metavar="K", help="measure every K-th view instead")
    parser.add_argument(
        "--color-corrected",
        action="store_true",
        help="print the PSNR with each view's own exposure, and after the best affine map of its colours, too",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="where to write (default: see above)")
    parser.add_argument(
        "--lpips-weights",
        type=Path,
        metavar="NPZ",
        help="weights of LPIPS (default: those that the training was given)",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Measure, print a table, write the files."""
    from minisplat_ref.app.runs.evaluation import evaluate_run
    from minisplat_ref.app.runs.scoring import summary

    evaluation, folder, notes = evaluate_run(
        args.folder,
        scene=args.scene,
        model=args.model,
        test_every=args.test_every,
        out=args.out,
        lpips_weights=args.lpips_weights,
    )
    width = max(len(view.name) for view in evaluation.per_view)
    corrected = "  exposed  corrected" if args.color_corrected else ""
    print(f"{'view':<{width}}  PSNR dB{corrected}    SSIM{'' if evaluation.lpips is None else '   LPIPS'}")
    for view in evaluation.per_view:
        corrected = f"  {view.psnr_exposed:7.2f}  {view.psnr_corrected:9.2f}" if args.color_corrected else ""
        lpips = "" if view.lpips is None else f"  {view.lpips:.4f}"
        print(f"{view.name:<{width}}  {view.psnr:7.2f}{corrected}  {view.ssim:.4f}{lpips}")
    print(summary(evaluation))
    for note in notes:
        print(f"minisplat-ref: warning: {note}", file=sys.stderr)
    if folder != args.folder:
        print(f"metrics and renders in {folder}")
    return 0
