"""The portrait front end: one photo to a linear image, a foreground mask, facial landmarks and a camera."""
