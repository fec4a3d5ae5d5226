"""The landmarks of a face by their indices in the mesh of MediaPipe's landmark network (Kartynnik et al. 2019).

There are `sira_mi.conventions.LANDMARKS` of them. Left and right are the subject's; pairs name the right side first.
"""

NOSE_TIP = 4
NOSE_UNDERSIDE = 1  # just below the tip
NOSE_BASE = 94  # foot of the columella
CHIN = 152
EYE_CORNERS = (33, 263)  # outer
INNER_EYE_CORNERS = (133, 362)
MOUTH_CORNERS = (61, 291)

# fmt: off
OVAL = (10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377, 152, 148, 176, 149,
        150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109)
JAW = OVAL[12:25]
RIGID = (33, 133, 362, 263, 168, 6, 197, 195, 5, 4, 1, 2, 19, 94, 98, 327, 48, 278, 64, 294, 122, 351, 193, 417, 9, 8)
BROWS = (70, 63, 105, 66, 107, 46, 53, 52, 65, 55, 300, 293, 334, 296, 336, 276, 283, 282, 295, 285)
# Around the opening between the lips, and around both lips.
LIPS = (78, 191, 80, 81, 82, 13, 312, 311, 310, 415, 308, 324, 318, 402, 317, 14, 87, 178, 88, 95)
LIP_BORDER = (61, 185, 40, 39, 37, 0, 267, 269, 270, 409, 291, 375, 321, 405, 314, 17, 84, 181, 91, 146)
MOUTH = LIP_BORDER + LIPS
# Around the opening of each eye, and on the skin below each.
EYES = ((33, 246, 161, 160, 159, 158, 157, 173, 133, 155, 154, 153, 145, 144, 163, 7),
        (263, 466, 388, 387, 386, 385, 384, 398, 362, 382, 381, 380, 374, 373, 390, 249))
BELOW_EYES = ((117, 118, 119, 101, 50, 100, 47, 126), (346, 347, 348, 330, 280, 329, 277, 355))
# On bare skin: upper cheeks, bridge of the nose, forehead between the brows.
BARE_SKIN = (50, 280, 101, 330, 117, 346, 118, 347, 6, 197, 9, 151)
CHEEKS = (50, 280, 205, 425, 101, 330, 151, 36, 266)  # and the forehead
# fmt: on
