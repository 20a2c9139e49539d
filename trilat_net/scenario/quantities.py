"""What numbers in a scenario may be: ranges, and how many of them.

Law: beyond `LARGEST` no quantity of an arm, a gain or a torque is meant; arithmetic stays far from its
limits.
"""

from typing import Annotated

from msgspec import Meta

LARGEST = 1e9

Positive = Annotated[float, Meta(gt=0.0, le=LARGEST)]
NotNegative = Annotated[float, Meta(ge=0.0, le=LARGEST)]
Real = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
Joints = Annotated[tuple[Real, ...], Meta(min_length=2, max_length=2)]
PositiveJoints = Annotated[tuple[Positive, ...], Meta(min_length=2, max_length=2)]
NotNegativeJoints = Annotated[tuple[NotNegative, ...], Meta(min_length=2, max_length=2)]
Parameters = Annotated[tuple[Real, ...], Meta(min_length=5, max_length=5)]
NotNegativeParameters = Annotated[tuple[NotNegative, ...], Meta(min_length=5, max_length=5)]
Rate = Annotated[int, Meta(ge=1, le=20_000)]
