"""Light between splats and surfaces, on Mitsuba's side: rays, transport, mirrors and shadows."""
