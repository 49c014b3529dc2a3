"""The robot: URDF on a free-flyer root, named arms and frames, the catalogue, composing, validation."""
