"""From LiDAR to a scene that Mitsuba and Sionna RT both open."""
