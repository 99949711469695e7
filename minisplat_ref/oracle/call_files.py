"""Golden vectors of a call of gsplat's: a folder that tests a renderer in any language without our code."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.io.atomic import making_folder
from minisplat_ref.oracle.call_comparison import Call, CallScene, truth

_README = """\
# Golden vectors of {call}

The inputs, results and gradients of a call of gsplat's, of {subject}, for {n} scenes, in float64, computed by the
reference of minisplat_ref. Input numbers are exact in float32.

- `SCENE/inputs.npz`: the arguments of the call. Its settings are in `manifest.json`.
- `SCENE/cotangents.npz`: `v_render_colors` and so on, the derivatives of the loss with respect to the images.
- `SCENE/results.npz`: the arrays below.

{scenes}

Write those of these arrays that your renderer has, into `mine/SCENE/anything.npz`, and run
`minisplat-ref oracle compare mine --call {call}`.

| array | stage | shape and meaning |
|---|---|---|
{rows}

There are N Gaussians and H x W pixels; the centre of the first pixel is (0.5, 0.5). Rows of culled Gaussians are not
compared, nor is the last row of the gradient of a view matrix.
"""


def export(call: Call, path: str | Path) -> tuple[CallScene, ...]:
    """Write the folder, completely or not at all, and return the scenes.

    Raises
    ------
    InputError
        The folder is not empty or cannot be made.
    """
    written = call.scenes()
    with making_folder(path) as folder:
        manifest = {}
        for scene in written:
            (folder / scene.name).mkdir()
            arrays = {name: value for name, value in scene.arguments.items() if isinstance(value, np.ndarray)}
            settings = {name: value for name, value in scene.arguments.items() if name not in arrays}
            files: dict[str, dict[str, Any]] = {
                "inputs": arrays,
                "cotangents": dict(scene.cotangents),
                "results": dict(truth(call, scene)),
            }
            for file, contents in files.items():
                np.savez(folder / scene.name / f"{file}.npz", **contents)
            manifest[scene.name] = {"what": scene.what, "settings": settings}
        tolerances = {
            name: {
                "float64": about.tolerance.float64,
                "float32": about.tolerance.float32,
                "why": about.tolerance.reason,
            }
            for name, about in call.stages.items()
        }
        text = json.dumps({"call": call.name, "scenes": manifest, "tolerances": tolerances}, indent=1)
        (folder / "manifest.json").write_text(text + "\n", encoding="utf-8")
        rows = "\n".join(f"| `{name}` | {about.stage} | {about.what} |" for name, about in call.stages.items())
        listed = "\n".join(f"- `{scene.name}`: {scene.what}" for scene in written)
        readme = _README.format(call=call.name, subject=call.subject, n=len(written), scenes=listed, rows=rows)
        (folder / "README.md").write_text(readme, encoding="utf-8")
    return written
