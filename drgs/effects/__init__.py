"""What a scene may call for besides splats before a pinhole, each imported when it does.

May import ``splatting``, ``config``, ``gaussians``, ``cameras`` and ``core``.
"""
