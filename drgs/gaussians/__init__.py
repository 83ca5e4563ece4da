"""The scene's type, its spherical harmonics, and how both are turned."""
