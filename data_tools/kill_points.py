"""``python -m data_tools.kill_points``: kill a training at every place where it could hurt, and continue it."""

from minisplat_ref.experiments.survival import main

if __name__ == "__main__":
    main()
