"""Synthesis of grasps with a hand: starts, descent, judgement."""
