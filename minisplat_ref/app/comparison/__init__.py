"""The command ``compare``, in its order: the plan, the runs, their metrics, the table, the report.

========================  ========================================================================
:mod:`.plan`              which recipe is trained with which seed, where, and for how long
:mod:`.runs`              the trainings, one after the other; those that were cut off continue
:mod:`.metrics`           metrics of finished runs; means over seeds
:mod:`.speed`             rendering the test views, all models interleaved
:mod:`.crops`             crops of test views for inspection
:mod:`.results`           all of these together, and compare.json
:mod:`.table`             mean, deviation and ratio to the first recipe, as text
:mod:`.table_files`       the table in CSV and LaTeX
:mod:`.figures`           PSNR over time, iterations and number of Gaussians; the gallery
:mod:`.report`            report.html
========================  ========================================================================
"""
