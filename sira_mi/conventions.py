"""Units and axes shared by the whole project, each stated once.

World: right-handed, +y up, the face looks along +z, the origin lies between the ears. Radiance is linear
Rec.709/sRGB. Environment directions are Mitsuba's: u = atan2(x, -z) / 2π, v = acos(y) / π. Cameras are OpenCV's
(x right, y down, z forward); pixel centres lie at half-integers.
"""

MILLIMETRES_PER_UNIT = 100.0

# The volume that a head, its hair and its shoulders may fill, in scene units. The field is solid down to the floor.
DOMAIN_LOWER = (-2.6, -3.0, -2.2)
DOMAIN_UPPER = (2.6, 2.0, 2.0)

# Rec.709 luminance of linear RGB.
LUMINANCE = (0.2126, 0.7152, 0.0722)

# Face landmarks of a photo or a head; `portrait/landmarks.py` names them.
LANDMARKS = 468

# Views of every scene of a collection that never enter training: renderings are compared on them.
HELD_OUT_VIEWS = (3, 6)
