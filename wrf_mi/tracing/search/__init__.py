"""Search: which chains of surfaces connect a transmitter and a receiver, and where paths meet them.

Module by module, in the order of a search:

- `surfaces`: triangles of the scene in float64, their planes, and the same closed at seams, for rays;
- `devices`: antennas on, behind and inside surfaces;
- `chains`: rays from a source find sequences of planes that may reflect; bounds of planes rule most of them out; and
  `PathInteractions`, the result, interactions of each path;
- `images`: the image method, points of reflection in float64;
- `visibility`: rays along the legs of candidates find what obstructs them, or is passed; at edges, float64 does.

Nothing here knows a material, an antenna or a field.
"""
