"""Scripts for work in the repository, which is where they run; the program itself is ``minisplat-ref``."""
