"""``python -m data_tools.fuzz``: have the readers of files read damaged ones, and print what they must not do."""

from minisplat_ref.experiments.fuzzing.run import main

if __name__ == "__main__":
    main()
