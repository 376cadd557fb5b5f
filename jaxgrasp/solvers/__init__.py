"""Mathematics that knows nothing of grasps."""
