"""Light between splats and surfaces along rays, imported where a scene uses it."""
