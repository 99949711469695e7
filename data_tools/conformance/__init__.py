"""What public renderers compute, and the rules in which they differ: probes, drivers, docs/CONFORMANCE.md.

Reading order: ``probes`` (scenes of one to forty Gaussians, each of which isolates a rule), ``judging`` (a picture
against the reference: agrees, differs as a rule, or unexplained), ``renderers`` (who is compared, in which version, and
what runs them), ``pages`` (viewers in a headless Chromium), ``report`` (the table). Nothing of theirs is kept here:
``python -m data_tools.conformance`` fetches each renderer by its name and version into a cache folder.
"""
