"""Surfaces of a scene as triangle meshes: reading, triangulating, outlines of planes, roles in the building."""
