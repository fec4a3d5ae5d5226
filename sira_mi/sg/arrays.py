"""Names of Dr.Jit's arrays for annotations.

Functions of this package take arrays of any variant and precision: tests run them in float64. The stubs of Mitsuba and
of Dr.Jit, moreover, give the same array two classes that share no arithmetic. For a type checker all names are `Any`.
"""

from typing import Any, TypeAlias

Bool: TypeAlias = Any
Color3f: TypeAlias = Any
Float: TypeAlias = Any  # also a Python number
Point2f: TypeAlias = Any
TensorXf: TypeAlias = Any
UInt32: TypeAlias = Any  # also a Python integer
Vector3f: TypeAlias = Any
