"""Scenes for Mitsuba and Sionna RT from LiDAR scans, plans and meshes."""
