"""What `jaxfilt.tune` is made of.

``split``: the data and their parts. ``parameters``: theta as a vector. ``loss``: the loss of many runs and its
gradient, compiled. ``batches``: what a step is taken on. ``setup``: what a tuning begins with. ``estimate``: noise
estimation by the truth. ``descent``, ``pursuit``: the way down, kept and resumed. ``held_out``: scores. ``curvature``,
``identify``: how sure the parameters are, and what the data do not tell. ``assessment``: all of that in words.
"""
