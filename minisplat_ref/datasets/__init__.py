"""Making and preparing scenes: ray-traced ones with exact truth, structure from motion, undistortion, downscaling."""
