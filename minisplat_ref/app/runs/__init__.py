"""Runs: a training with everything around it, and what is done with its folder afterwards.

Train: what ``train`` does
    :mod:`.options` (all that can be asked for, each declared once), :mod:`.settings` (what was asked for in
    ``config.json``, and its recipe, photographs and model), :mod:`.proposed_size` and :mod:`.room` (which size fits
    into memory), :mod:`.start` (points to start from), :mod:`.run_folder` (the folder is made; which file has which
    name), :mod:`.run` (the training), :mod:`.first_use` (compiles the kernels ahead), :mod:`.checkpoints` (the last
    two, and the newest model), :mod:`.fingerprint` (which scene the run belongs to).

Several runs at once
    :mod:`.cluster` (connect to workers, check them, hand out), :mod:`.worker` (what a worker does with a job),
    :mod:`.attached` (its command, which ends with it).

What a run records
    :mod:`.progress` (bar and ``log.jsonl``), :mod:`.events` (what fired, ``events.jsonl``), :mod:`.curve`
    (``curve.jsonl``), :mod:`.preview` (an image of the training), :mod:`.scoring` (``metrics.json`` and ``renders/``).

Afterwards
    :mod:`.evaluation` (``eval``: measure again), :mod:`.conversion` (``convert``), :mod:`.notices` (what a run can do
    without, but should be told of), :mod:`.model_file` (who draws a file, and what it lacks of its run).

A mesh: what ``mesh`` does
    :mod:`.depth_maps` (what a camera shows of the surface), :mod:`.meshing` (fused and extracted) and
    :mod:`.mesh_report`.

A smaller model: what ``simplify`` does
    :mod:`.opened_run` (what is read of the run, and its folds of views), :mod:`.rate_distortion` (drop, standard error,
    and the search for a size by them), :mod:`.simplification` (sizes reached, fine-tuned and measured) and
    :mod:`.simplified_run` (the new folder).

Its reports
    :mod:`.run_report`, :mod:`.demo_report`, :mod:`.simplification_report`, of :mod:`.report_parts`, :mod:`.fired`
    (which mechanisms acted) and :mod:`.decisions_report` (what ``adaptive`` decided).
"""
