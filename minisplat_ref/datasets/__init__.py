"""Programs that make and prepare scenes: synthetic scenes, structure from motion, undistortion, downscaling."""
