"""From matching scores to a verified transformation, in NumPy float64.

In order: ``correspondences`` (who matches whom), ``procrustes`` (the transformation a set
of correspondences implies), ``consensus`` (many such transformations, from correspondences
that agree with one another), ``surface`` (a scan as something to register against),
``partners`` (clouds that share their points), ``refinement`` (point-to-plane ICP, coarse and
at full resolution), ``verification`` (how well two scans fit, free space included) and
``solver``, which ties them together.

Every tolerance is relative to h, the spacing of the network's nodes, or to the points' own
spacing, so nothing depends on the unit of length. Nothing here draws random numbers.
"""
