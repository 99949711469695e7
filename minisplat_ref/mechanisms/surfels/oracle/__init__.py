"""The oracle for ``rasterization_2dgs``: scenes, golden vectors, comparison by stages, planted errors, hard cases."""
