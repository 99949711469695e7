"""Runs: a training with everything around it, and the uses of its folder afterwards.

The command ``train``
    :mod:`.options` (the declaration of every setting), :mod:`.settings` (the requested settings in ``config.json``, and
    the recipe, photographs and model that they mean), :mod:`.proposed_size` and :mod:`.memory_needs` (the size that
    fits into memory), :mod:`.start` (points to start from), :mod:`.run_folder` (makes the folder; the names of its
    files), :mod:`.run` (the training), :mod:`.first_use` (compiles the kernels ahead), :mod:`.checkpoints` (the last
    two, and the newest model), :mod:`.fingerprint` (identifies the scene of the run).

Several runs at once
    :mod:`.cluster` (connect to workers, check them, hand out), :mod:`.worker` (the worker's side of a job),
    :mod:`.attached_process` (its command, which ends with it).

Records of a run
    :mod:`.progress` (bar and ``log.jsonl``), :mod:`.events` (mechanisms that fired, ``events.jsonl``), :mod:`.curve`
    (``curve.jsonl``), :mod:`.preview` (an image of the training), :mod:`.scoring` (``metrics.json`` and ``renders/``).

Afterwards
    :mod:`.evaluation` (``eval``: measure again), :mod:`.conversion` (``convert``), :mod:`.notices` (warnings that do
    not stop a run), :mod:`.model_file` (the extension that renders a file, and what it lacks of its run).

A mesh: the command ``mesh``
    :mod:`.depth_maps` (maps of the surface from a camera), :mod:`.meshing` (fused and extracted) and
    :mod:`.mesh_report`.

A smaller model: the command ``simplify``
    :mod:`.opened_run` (the parts of the run that are read, and its folds of views), :mod:`.rate_distortion` (drop,
    standard error, and the search for a size by them), :mod:`.simplification` (sizes reached, fine-tuned and measured)
    and :mod:`.simplified_run` (the new folder).

Its reports
    :mod:`.run_report`, :mod:`.demo_report`, :mod:`.simplification_report`, of :mod:`.report_parts`,
    :mod:`.recipe_actions` (the mechanisms that acted) and :mod:`.decisions_report` (decisions of ``adaptive``).
"""
