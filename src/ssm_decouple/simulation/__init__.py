"""Motions under a law, and the record of a motion."""
