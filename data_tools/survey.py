"""``python -m data_tools.survey``: plant errors and print which command of the oracle notices which."""

from minisplat_ref.experiments.survey import main

if __name__ == "__main__":
    main()
