"""Pairs of scans with a known answer, made from triangle meshes in NumPy and SciPy.

Training, benchmark and demo share this room. A mesh (from a packed library or procedural)
is sampled densely, stretched and warped into something organic, seen by a virtual range
scanner from two sides, thinned, disturbed and moved by two random rigid motions.

- ``shapes``: libraries of triangle meshes; ``packing``: opens or makes one from what a user names
  (``shape_files``, ``mesh_form``, ``reconstruction`` of clouds, ``modelnet40``; kept in ``shape_cache``).
- ``procedural``, its ``families`` and ``implicit`` solids: meshes made here.
- ``surface``, ``warp``: a mesh as a dense sample; smooth deformations of it.
- ``scanner``: what a range scanner sees of it. ``crops``: the paper's way to cut it.
- ``pairs``: the mixture (``random_pair``) and the seeded test pairs (``evaluation_pairs``);
  its parts are ``range_pairs`` and ``surface_pairs``, its settings ``settings``.

Frames: *object* frame is the warped mesh about the origin with radius about 1; each scan
has its own frame, a random rigid motion away. ``p_target = gt_T_target_source @ p_source``.
*Extent* is the diagonal of the bounding box of the whole object.
"""
