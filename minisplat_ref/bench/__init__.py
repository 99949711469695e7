"""Speed against error: the time that a backend, a precision or a shortcut takes, and the error that it makes.

Reading order: ``workloads`` (what is rendered), ``contenders`` (what renders it: backends, ``exponentials``, cut-offs,
the ``textbook`` loop, ``peers``), ``passes`` (through which public functions), ``judging`` (errors against float64,
apart from pixels at a threshold), ``benchmark`` (times and errors in one run), ``figure`` (the Pareto figure); then
``profiling`` and ``training_time`` (where an iteration spends its time), ``worked_rows`` (how much work blending is),
``extension_times`` (an extension's renderer), ``opensplat`` (another trainer). What this machine's limits, memory and
start are is measured in the repository alone: ``data_tools/machine``.

Left out: comparisons with times from another run. Machines differ, and so does one machine from hour to hour; only
ratios within a run are meaningful.
"""
