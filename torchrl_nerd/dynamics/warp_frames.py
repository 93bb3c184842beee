"""Contact frames of MuJoCo Warp, made orthonormal as MuJoCo's are.

mujoco-warp 4.0.0 leaves the first tangent of a plane and a capsule that stands on it askew
where the plane is tilted (its `plane_capsule`), which makes friction wrong there. Imported
where MuJoCo Warp is used only: defining a kernel needs Warp.
"""

from typing import Any

import warp as wp


@wp.kernel
def _orthonormalize(count: wp.array[int], frame: wp.array[wp.mat33]):
    contact = wp.tid()
    if contact >= count[0]:
        return
    normal, askew = frame[contact][0], frame[contact][1]
    tangent = wp.normalize(askew - wp.dot(normal, askew) * normal)
    frame[contact] = wp.matrix_from_rows(normal, tangent, wp.cross(normal, tangent))


def straighten_frames(model: Any, data: Any) -> None:
    """Turn the first tangent of every contact into the plane across its normal, in place.

    A ``contactfilter`` of MuJoCo Warp: called between collision and constraints.
    """
    wp.launch(
        _orthonormalize, dim=data.naconmax, inputs=[data.nacon, data.contact.frame]
    )
