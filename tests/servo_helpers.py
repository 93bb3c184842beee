"""A robot with every kind of actuator that MuJoCo evaluates without a state."""

from pathlib import Path
from typing import Any

from torchrl_nerd.scenes import Scene

SERVOS = """
<mujoco><option timestep="0.002" integrator="{integrator}"/>
  <default><geom contype="1" conaffinity="0"/></default><worldbody>
  <geom name="floor" type="plane" size="0 0 1" contype="0" conaffinity="1"/>
  <body pos="0 0 1"><freejoint/><geom type="box" size="0.2 0.1 0.05" mass="3"/>
    <site name="side" pos="0.1 0.1 0" quat="0.9 0.1 0.3 0.2"/><site name="crank"/>
    <body pos="0.3 0 0"><joint name="a" axis="0 1 0" range="-60 60"
        limited="true" actuatorfrcrange="-6 5"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.03" mass="0.5"/>
      <body pos="0.2 0 0" gravcomp="0.5"><joint name="b" axis="0 1 0.2" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.03" mass="0.4"/>
        <site name="tip" pos="0.2 0 0"/>
      </body></body>
    <body pos="-0.3 0 0"><joint name="c" type="slide" axis="1 0 0"/>
      <geom type="sphere" size="0.05" mass="0.5"/>
      <body name="foot" pos="-0.1 0 0"><joint name="d" type="ball"/>
        <geom type="capsule" fromto="0 0 0 -0.2 0 0" size="0.03" mass="0.4"/>
        <site name="tool" pos="-0.2 0 0"/>
      </body></body>
  </body></worldbody>
  <tendon><fixed name="t"><joint joint="b" coef="0.7"/><joint joint="c" coef="-2"/>
  </fixed><spatial name="wire"><site site="side"/><site site="tip"/></spatial></tendon>
  <actuator>
    <position joint="a" kp="20" kv="1" gear="1.5" ctrlrange="-0.5 1"/>
    <motor joint="a" gear="3" ctrlrange="-1 0.5"/>
    <velocity joint="b" kv="2" forcerange="-1 0.5"/>
    <general tendon="t" gear="2" gainprm="5" biastype="affine" biasprm="0.3 -4 -0.2"/>
    <damper joint="c" kv="3" ctrlrange="0 1"/>
    <position joint="c" kp="9" dampratio="0.7" damping="0.2" armature="0.1"/>
    <motor joint="d" gear="1 2 -0.5"/><motor joint="d" gear="0 1 0"/>{more}
  </actuator></mujoco>"""
"""Every actuator there is law for: several on a joint, on a tendon, on a ball, limited."""

ARM = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <body><joint name="a" axis="0 1 0" range="-2 2" damping="1"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.05"/>
    <body pos="0.3 0 0"><joint name="b" axis="0 1 0" range="-2 2" damping="1"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.05"/></body>
  </body></worldbody><actuator>
    <position joint="a" kp="4500" kv="450" ctrlrange="-2 2" forcerange="-87 87"/>
    <position joint="b" kp="3500" kv="350" ctrlrange="-2 2" forcerange="-87 87"/>
  </actuator><keyframe><key qpos="0.3 -0.4" ctrl="0.3 -0.4"/></keyframe></mujoco>"""
"""Two links held by servos as stiff as those of a Franka."""

ENGINE_ALONE = """
    <motor site="tool" gear="1 0.5 0 0 0.1 0"/>
    <position site="tool" refsite="side" kp="2" kv="0.1" gear="0 0 1 0 0 0"/>
    <position joint="d" kp="2" gear="0 1 0"/>
    <motor jointinparent="d" gear="0 0.3 1"/>
    <motor tendon="wire" gear="-3" ctrlrange="0 1"/>
    <general cranksite="crank" slidersite="tip" cranklength="0.5" gainprm="2"/>
    <general joint="b" gaintype="muscle" gainprm="0.75 1 5 200 0.5 1.6 1.5 1.3 1.2"
      biastype="muscle" biasprm="0.75 1 5 200 0.5 1.6 1.5 1.3 1.2" lengthrange="-3 3"/>
    <adhesion body="foot" ctrlrange="0 1" gain="5"/>"""
"""Actuators whose torque MuJoCo alone computes, for a floating base: on sites, in a
parent's axes, on the angle of a ball joint, spatial tendon, slider-crank, muscle, body."""


def servo_scene(
    folder: Path,
    integrator: str = "Euler",
    control_step: float = 0.004,
    more: str = "",
    **ranges: Any,
) -> Scene:
    """The robot of `SERVOS`, with ``more`` actuators."""
    path = folder / "servos.xml"
    path.write_text(SERVOS.format(integrator=integrator, more=more))
    return Scene.from_mjcf(path, control_step, **ranges)


def arm_scene(folder: Path, **ranges: Any) -> Scene:
    """The arm of `ARM`."""
    path = folder / "arm.xml"
    path.write_text(ARM)
    return Scene.from_mjcf(path, **ranges)
