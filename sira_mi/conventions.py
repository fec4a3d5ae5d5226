"""Units and axes of the whole project.

World: right-handed, +y up, the face looks along +z, the origin lies between the ears. Radiance is linear
Rec.709/sRGB. Environment directions are Mitsuba's: u = atan2(x, -z) / 2π, v = acos(y) / π. Cameras are OpenCV's
(x right, y down, z forward); pixel centres lie at half-integers.
"""

MILLIMETRES_PER_UNIT = 100.0

# Bounds of a head with its hair and shoulders, in scene units. The field is solid down to the lower bound in y.
DOMAIN_LOWER = (-2.6, -3.0, -2.2)
DOMAIN_UPPER = (2.6, 2.0, 2.0)

# Rec.709 luminance of linear RGB.
LUMINANCE = (0.2126, 0.7152, 0.0722)

# Face landmarks of a photo or a head; `portrait/landmarks.py` names them.
LANDMARKS = 468
# As many determine the pose of a head in a photo.
LEAST_LANDMARKS = 6

# Views of every training scene that are held out of training, for comparison with renderings.
HELD_OUT_VIEWS = (3, 6)
