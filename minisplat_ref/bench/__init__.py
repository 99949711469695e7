"""Speed against error: the time that a backend, a precision or a shortcut takes, and the error that it makes.

Reading order: ``workloads`` (the scenes), ``contenders`` (the renderers: backends, ``exponentials``, cut-offs,
the ``textbook`` loop, ``peers``), ``passes`` (the public functions that are timed), ``judging`` (errors against
float64, apart from pixels at a threshold), ``benchmark`` (times and errors in one run), ``figure`` (the Pareto figure);
then ``profiling`` and ``training_time`` (the time of an iteration by stages), ``worked_rows`` (the work of blending),
``extension_times`` (an extension's renderer), ``opensplat`` (another trainer). The machine's limits, the memory and the
start time are measured in the repository only: ``data_tools/machine``.

Left out: comparisons with times from another run. Machines differ, and so does one machine from hour to hour; only
ratios within a run are meaningful.
"""
