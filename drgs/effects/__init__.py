"""Effects besides splats before a pinhole, each imported when a scene uses it."""
