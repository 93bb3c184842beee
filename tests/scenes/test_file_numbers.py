"""Numbers that no robot has are refused in one sentence, which names the file."""

import os

import mujoco
import pytest

from torchrl_nerd.scenes import Scene, import_scene

DEFAULT = {"mass": "1", "pos": "0", "damping": "0.1", "range": "-90 90", "gear": "1"}
DEFAULT |= {"timestep": "0.002", "gravity": "-9.81", "ctrlrange": "-1 1"}
ROBOT = """<mujoco><option timestep="{timestep}" gravity="0 0 {gravity}"/>
  <compiler autolimits="true"/><worldbody><body pos="0 0 {pos}">
    <joint name="a" axis="0 1 0" damping="{damping}" range="{range}"/>
    <geom size="0.1" pos="0.1 0 0" mass="{mass}"/></body></worldbody>
  <actuator><motor name="m" joint="a" gear="{gear}" ctrlrange="{ctrlrange}"/></actuator>
</mujoco>"""


def write(folder, **numbers):
    path = folder / "robot.xml"
    path.write_text(ROBOT.format(**DEFAULT | numbers))
    return path


def refusal(path, capfd) -> str:
    with pytest.raises(ValueError) as refused:
        Scene.from_mjcf(path)
    assert capfd.readouterr() == ("", "")  # MuJoCo warns of nothing
    said = str(refused.value)
    assert "\n" not in said and str(path) in said
    return said


def test_the_robot_with_usual_numbers_is_read(tmp_path):
    assert Scene.from_mjcf(write(tmp_path)).controller.num_actions == 1


@pytest.mark.parametrize("name", DEFAULT)
def test_nan_is_refused(name, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    value = {"range": "nan 90", "ctrlrange": "-1 nan"}.get(name, "nan")
    path = write(tmp_path, **{name: value})
    assert refusal(path, capfd) == f"expected finite numbers in {path}, got NaN"
    assert list(tmp_path.iterdir()) == [path]  # no MUJOCO_LOG.TXT


@pytest.mark.parametrize(
    ("numbers", "field"),
    [
        ({"damping": "inf"}, "dof_damping"),
        ({"pos": "inf"}, "body_pos"),
        ({"timestep": "inf"}, "timestep"),
        ({"gravity": "-inf"}, "gravity"),
        ({"gear": "1e300"}, "actuator_acc0"),
    ],
)
def test_what_is_not_finite_in_the_compiled_model_is_named(
    numbers, field, tmp_path, capfd
):
    said = refusal(write(tmp_path, **numbers), capfd)
    assert "expected finite numbers of a possible size" in said and field in said


@pytest.mark.parametrize("limit", ["1.01e10", "1e300"])
def test_controls_that_mujoco_gives_up_on_are_refused(limit, tmp_path, capfd):
    path = write(tmp_path, ctrlrange=f"-1 {limit}")
    said = refusal(path, capfd)
    assert "an actuator with a control range beyond 1e+10 ('m' of " in said
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.ctrl[:] = float(limit)
    mujoco.mj_step(model, data)
    assert data.warning[mujoco.mjtWarning.mjWARN_BADCTRL].number == 1
    assert Scene.from_mjcf(write(tmp_path, ctrlrange="-1 1e4"))


def test_a_robot_is_read_again_once_a_file_that_it_includes_has_changed(tmp_path):
    whole, body = DEFAULT | {"mass": "2"}, "<body" + ROBOT.split("<body")[1]
    part, main = body.split("</worldbody>")[0], tmp_path / "robot.xml"
    (tmp_path / "parts").mkdir()
    included = tmp_path / "parts" / "arm.xml"
    main.write_text(
        ROBOT.replace(part, '<include file="parts/arm.xml"/>').format(**whole)
    )
    for mass in ("1", "2"):
        text = part.format(**DEFAULT | {"mass": mass})
        included.write_text(f"<mujocoinclude>{text}</mujocoinclude>")
        os.utime(included, ns=(0, int(mass)))  # some disks tell seconds alone
        first, again = import_scene(str(main)), import_scene(str(main))
        assert first is again and first.model.body_mass[1] == float(mass)


def test_a_path_has_one_name_however_it_is_typed(tmp_path, monkeypatch):
    write(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert import_scene("./robot.xml").name == import_scene("robot.xml").name
