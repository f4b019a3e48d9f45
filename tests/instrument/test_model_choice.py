"""What a choice of model changes in the priors of a rig, and what it keeps."""

from __future__ import annotations

from tvsbayes.instrument.model_choice import HARMONIC_SD_DEG, ModelChoice
from tvsbayes.instrument.parameters import HARMONIC_NAMES, Prior
from tvsbayes.instrument.rig import RigTable


def test_the_choice_of_a_model_keeps_what_the_rig_states():
    stated = {"harmonic_deg.pan.2.cos": Prior(0.02, 0.005), "harmonic_deg.pan.2.sin": Prior(0.03, 0.0)}
    table = RigTable(stated, harmonic_period_deg={"pan": (30.0,)})
    assert ModelChoice().table(table) == table
    chosen = ModelChoice(harmonics=True).table(table)
    names = {"harmonic_deg.pan.1.cos", "harmonic_deg.pan.1.sin"}
    assert {n for n in HARMONIC_NAMES if chosen.priors[n] == Prior(0.0, HARMONIC_SD_DEG)} == names
    assert all(chosen.priors[name] == prior for name, prior in stated.items())
    assert all(p == Prior(0.0, 0.0) for n, p in chosen.priors.items() if n.startswith("harmonic_deg.tilt"))
    bare = ModelChoice(no_backlash=True, per_axis=True).table(table).priors
    changed = {name for name, prior in bare.items() if prior != table.priors[name]}
    stems = ("backlash_deg", "play_variation_deg", "ratio_contrast_deg_per_step")
    assert changed == {f"{stem}.{axis}" for stem in stems for axis in ("pan", "tilt")}
    assert all(bare[name].u == 0 for name in changed)
    perfect = ModelChoice(perfect_gears=True).table(table).priors
    assert all(perfect[name] == table.priors[name] for name in HARMONIC_NAMES)
