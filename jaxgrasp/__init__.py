"""Rank multi-fingered grasps by how strong a disturbance they withstand, in batch, with the forces that do it."""
