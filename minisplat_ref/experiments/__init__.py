"""Trainings with everything around them: runs and their folders, comparisons, studies, and the reports of all."""
