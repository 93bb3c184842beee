"""The real cube of the ContactNets tosses: 0.37 kg, otherwise as the simulated one."""

from torchrl_nerd.scenes.cube import CONTACT, cube_scene
from torchrl_nerd.scenes.scene import Scene

# The paper's numbers times the ratio of the masses, so that both cubes fall and bounce
# alike. Its own damping of 1,000 N s/m would be unstable: over one substep it changes a
# corner's speed by 4.3 times that speed, where 2 is the limit.
LIGHTER = 0.37 / 1.15102


def cube_real() -> Scene:
    """Build the scene. ``qpos`` = centre (m), quaternion."""
    forces = {key: LIGHTER * CONTACT[key] for key in ("ke", "kd", "kf")}
    return cube_scene("cube_real", {**forces, "mu": CONTACT["mu"]})
