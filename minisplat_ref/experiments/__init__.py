"""Trainings with everything around them: a run and its folder, comparisons, studies, and the reports of all.

A run and its folder: what ``train`` does
    :mod:`.settings` (what was asked for, ``config.json``), :mod:`.start` (points to start from), :mod:`.run_folder`
    (which file is called what), :mod:`.run` (the training), :mod:`.checkpoints` (the last two, and the newest model),
    :mod:`.fingerprint` (which scene the run belongs to), :mod:`.progress` (bar and ``log.jsonl``), :mod:`.events` (what
    fired, ``events.jsonl``), :mod:`.curve` (``curve.jsonl``) and :mod:`.surface` (the true one, where it is known),
    :mod:`.scoring` (``metrics.json`` and ``renders/``), :mod:`.evaluation` (measuring again), :mod:`.first_use`
    (compiles the kernels ahead), :mod:`.notices` (warns of what a run can do without, but should be told of).
    :mod:`.kill_points` and :mod:`.survival` kill a training wherever it could hurt (``python -m
    data_tools.kill_points``).

A smaller model from a run: what ``simplify`` does
    :mod:`.opened_run` (what is read of the run, and the views that decide), :mod:`.rate_distortion` (drop, standard
    error, rule and knee, by which a size is chosen), :mod:`.simplification` (sizes ranked, fine-tuned and measured),
    :mod:`.simplified_run` (the new folder).

More than one run
    :mod:`.comparison` (several recipes side by side: ``compare``), :mod:`.studies` (what a choice in a method does:
    ``study``), :mod:`.measure` (the runs of docs/measured: ``python -m data_tools.measure``).

The report kit
    :mod:`.page` (a page of HTML, from cards, tables, panels), :mod:`.plots` (curves as SVG and PNG), :mod:`.pictures`
    (renders, errors and depths for the eye); :mod:`minisplat_ref.reporting` has tables in Markdown and the machine.
    Three reports are made of it: :mod:`.demo_report`, :mod:`.comparison.report` and :mod:`.simplification_report`.

:mod:`.arguments` is what the command line's parsers share. :mod:`.fuzzing` has every reader of files read damaged ones:
``python -m data_tools.fuzz``.
"""
