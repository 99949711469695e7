"""Kill a training at every place where it could hurt, and continue it: ``python -m data_tools.kill_points``.

:mod:`.points` is where a training is killed, :mod:`.survival` what must hold afterwards.
"""
