"""Speed against error: the time that a backend, a precision or a shortcut takes, and the error that it makes.

Reading order: ``workloads`` (what is drawn), ``contenders`` (what draws it: backends, ``exponentials``, cut-offs, the
``textbook`` loop, ``peers``), ``passes`` (through which public functions), ``judging`` (errors against float64, apart
from pixels at a threshold), ``benchmark`` (times and errors in one run), ``figure`` (the Pareto figure); then
``profiling`` (where a training iteration spends its time), ``limits`` and ``roofline`` (single stages, and the limits
that the machine sets), ``opensplat`` (another trainer).

Left out: comparisons with times from another run. Machines differ, and so does one machine from hour to hour; only
ratios within a run are meaningful.
"""
