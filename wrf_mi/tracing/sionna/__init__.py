"""Adapter to Sionna RT: scenes, radio materials, its random search and its field calculator.

- `scenes`: opens a scene from a name, a folder, a Mitsuba XML or a mesh, also with shapes that Sionna RT lacks;
- `materials`: radio materials at a carrier, also below the range of its table;
- `path_solver`: diffraction and scattering by its random search, gains of paths by its field calculator.
"""
