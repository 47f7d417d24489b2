"""Scenes of a user's own by name: registered, or announced by a plug-in, in Python and on the command line."""

from importlib import metadata
from importlib.metadata import EntryPoint

import pytest

from sympflow import HamiltonianSystem, systems

SEVEN = 7


def anharmonic(strength: float = 0.1, times: int = 1) -> HamiltonianSystem:
    H = f"p**2/2 + {times}*q**2/2 + strength*q**4"
    return HamiltonianSystem.from_sympy(H, params={"strength": strength}, name="anharmonic", y0=[1.0, 0.0])


def not_a_system():
    return 3


def needs_an_argument(a):
    return a


@pytest.fixture
def announced(monkeypatch):
    points = [
        EntryPoint("anharmonic_well", f"{__name__}:anharmonic", systems.GROUP),
        EntryPoint("henon_heiles", f"{__name__}:anharmonic", systems.GROUP),
        EntryPoint("seven", f"{__name__}:SEVEN", systems.GROUP),
        EntryPoint("three", f"{__name__}:not_a_system", systems.GROUP),
        EntryPoint("absent", "a_module_that_does_not_exist:factory", systems.GROUP),
    ]
    monkeypatch.setattr(metadata, "entry_points", lambda group: [p for p in points if p.group == group])
    monkeypatch.setattr(systems, "_registered", {})
    for found in (systems._plugins, systems._load):
        found.cache_clear()
    yield
    for found in (systems._plugins, systems._load):
        found.cache_clear()


def test_scenes_of_plugins_are_listed_and_made(announced):
    with pytest.warns(RuntimeWarning, match="The system 'henon_heiles' of .* is ignored: the name is taken"):
        assert {"anharmonic-well", "seven", "absent"} <= set(systems.available())
    assert systems.get("anharmonic-well") is systems.get("anharmonic_well") is anharmonic
    assert systems.get("henon_heiles") is systems.henon_heiles
    with pytest.raises(ImportError, match=r"^`system` 'seven' of the plug-in .* is not a function with a default"):
        systems.get("seven")
    with pytest.raises(ImportError, match=r"^`system` 'absent' of the plug-in .* cannot be loaded \(ModuleNotFound"):
        systems.get("absent")


@pytest.mark.filterwarnings("ignore:The system 'henon_heiles'")
def test_registered_scenes_are_known(announced):
    systems.register("my_well", anharmonic)
    assert "my-well" in systems.available()
    assert systems.get("my_well")(strength=0.5).params == {"strength": 0.5}
    for name, factory, error, message in (
        ("henon-heiles", anharmonic, ValueError, r"^`name` 'henon-heiles' is a built-in scene"),
        ("anharmonic_well", anharmonic, ValueError, r"^`name` 'anharmonic_well' belongs to the plug-in"),
        ("a b", anharmonic, ValueError, r"^`name` must be a word"),
        ("other", needs_an_argument, TypeError, r"^`factory` must be a function that makes the system"),
        ("other", anharmonic(), TypeError, r"^`factory` must be a function that makes the system"),
        (3, anharmonic, TypeError, r"^`name` must be a string"),
    ):
        with pytest.raises(error, match=message):
            systems.register(name, factory)
    with pytest.raises(ValueError, match=r"^`name` 'my-wel' is not a known scene. Did you mean 'my-well'"):
        systems.get("my-wel")
