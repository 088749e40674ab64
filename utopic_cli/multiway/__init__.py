"""Many scans into one model: pairs, a graph of them, groups of scans that connect.

The path of a batch: ``scans`` (which files, under which names) -> ``plan`` -> ``tasks`` in ``workers`` or
on a ``cluster`` (describe every scan, register pairs) -> ``journal`` (each answer on disk, at once) ->
``pairs`` (which to try next) -> ``edges`` -> ``loops`` (what triangles say of each edge) -> ``groups``
(which scans connect) -> ``pose_graph`` (all transformations at once) -> ``model`` -> ``tables``, ``merge``
and ``page`` of the ``outcome``. ``batch`` is that path; ``trial`` measures it.

Frames: each group has a world frame, that of its first scan: ``p_world = T_world_scan @ p_scan``.
An edge is ``p_target = T_target_source @ p_source``.
"""
