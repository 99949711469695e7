"""The oracle for ``rasterization`` through lenses and parallel rays: scenes, stages, planted errors, hard cases."""
