"""Walls, floor and ceiling from plans: occupancy grids, LiDAR returns in a plane, wall vertices."""
