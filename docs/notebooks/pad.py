# %% [markdown]
# # From an idea to a calibrated sensor
#
# This notebook designs a small pad, makes its mould, presses it on a simulated rig, and learns to locate touches, in a
# minute. It needs `pip install 'padforge[design,cad,formats]' scikit-learn`.

# %%
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Image
from sklearn.model_selection import cross_val_score

from padforge import design, fabricate, sense

# %% [markdown]
# ## Design
#
# Three horizontal and three vertical fibres. A search bends them so that every touch changes several of them, also when
# some fail, and keeps them buildable. More `starts` and `steps` find better pads; the defaults take half a minute.

# %%
pad_settings = design.PadSettings(grid=3)
quick = design.SearchSettings(starts=1, steps=100)
found = design.search(pad_settings, settings=quick)
for failed in range(4):
    name = f"expected_error_mm_{failed}"
    print(f"{failed} failed: {found.terms[name]:.2f} mm, straight fibres {found.straight[name]:.2f} mm")

# %%
design.draw_plan(found.morphology, design.Contact()).savefig("plan.png")
Image("plan.png")

# %% [markdown]
# ## Mould
#
# The mould is an inverse one: its ridges become the tracks that the fibres are laid in. `build` writes the files that a
# lab prints and works by, among them `mould.stl`, `mould.step` and the page `laying.md`; `build_mould` gives the same
# solid to [build123d](https://build123d.readthedocs.io), to be edited. Its numbers are mirrored on purpose: on the
# casting they read the right way.

# %%
built = fabricate.build(found.morphology, "mould", formats=["stl", "png"])
print(f"{built.mould_volume_ml:.0f} ml of plastic, {built.silicone_volume_ml:.0f} ml of silicone")
print(f"{sum(finding.status == 'pass' for finding in built.findings)} of {len(built.findings)} checks passed")
Image("mould/figures/mould.png")

# %% [markdown]
# ## Presses
#
# A simulated rig presses the pad with noise, drift and the scatter of a built one. Real presses come from `padforge
# sense record`, from files, or from arrays of your own.

# %%
recording = sense.simulate(found.morphology, sense.RigSettings(presses=240), pad_settings=pad_settings)
shown = recording.times_s < 30
plt.plot(recording.times_s[shown], recording.readings[shown])
plt.xlabel("time (s)")
plt.ylabel("reading (V)")
plt.show()

# %% [markdown]
# Arrays of readings are enough for a recording: presses are detected in them, and where they were, if it is known, is
# given as `presses_mm`.

# %%
yours = sense.Recording.from_arrays(recording.readings, recording.times_s)
print(f"{len(yours)} presses of {yours.fibres} fibres, {yours.rate_hz:.1f} readings a second")

# %% [markdown]
# ## Calibration
#
# A localizer learns positions from presses, and is tested on those that it has not seen: with all fibres, and with each
# set of failed ones.

# %%
localizer = sense.Localizer(epochs=20).fit(recording)
evaluation = localizer.calibration_
evaluation.to_frame()[["n_failed", "mean_mm", "median_mm", "p95_mm", "within_r90"]].round(2)

# %%
pressed, located = (np.array(evaluation.test[name]) for name in ("pressed_mm", "predicted_mm"))
plt.plot(*np.stack([pressed, located], axis=1).T, color="tab:red")
plt.plot(*pressed.T, "o", markersize=3)
plt.gca().set_aspect("equal")
plt.title("from where the pad was pressed to where the press was located, mm")
plt.show()

# %% [markdown]
# ## Cross-validation
#
# A localizer is an estimator of scikit-learn, and a recording is split by its presses. Scores are negative mean errors,
# in mm.

# %%
-cross_val_score(sense.Localizer(epochs=3), recording, cv=3)
