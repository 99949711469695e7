"""Speed against error: what a backend, a precision or a short cut costs, and what it spoils.

Reading order: ``workloads`` (what is drawn), ``contenders`` (who draws it: backends, ``exponentials``, cut-offs, the
``textbook`` loop, ``peers``), ``passes`` (through which public functions), ``judging`` (errors against float64, pixels
at a threshold apart), ``race`` (times and errors in one run), ``figure`` (the Pareto figure); then ``profiling`` (where
a training iteration spends its time), ``limits`` and ``roofs`` (single stages, and how far the machine would let them
go), ``opensplat`` (another trainer).

Left out: no time is compared with a number from another run. Machines differ, and so does one machine from hour to
hour; only ratios inside one run mean something.
"""
