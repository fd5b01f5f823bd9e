"""Interactive 3D views of scenes, runs and maps: one self-contained HTML file."""
