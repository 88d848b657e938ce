# SPDX-License-Identifier: BSD-3-Clause
"""Rendered boxes and facades on which the search for structure was chosen, and those that it is reported on."""

from _buildings import BuildingSettings
from _rendered_boxes import BoxSettings

_SMALL = {"width": 640, "height": 480, "focal": 560.0, "num_images": 16}
_FACADE = {"num_boxes": 3, "num_panels": 40, "cameras": "front", **_SMALL}
#: The search was developed on these; the next group was not used for that.
CHOSEN_ON = {
    "boxes 701": BoxSettings(seed=701, texture=8.0, **_SMALL),
    "boxes 702, random views": BoxSettings(seed=702, texture=8.0, **{**_SMALL, "cameras": "random"}),
    "facade 711": BoxSettings(seed=711, texture=8.0, **_FACADE),
    "facade 712, rough": BoxSettings(seed=712, texture=8.0, rough=0.01, **_FACADE),
    "boxes 703, round bodies": BoxSettings(seed=703, texture=10.0, **{**_SMALL, "num_boxes": 5, "num_round": 6}),
    "boxes 704, wide": BoxSettings(seed=704, texture=12.0, **{**_SMALL, "focal": 420.0}),
    "facade 713, rough": BoxSettings(seed=713, texture=12.0, rough=0.012, **_FACADE),
    "facade 714, rough": BoxSettings(seed=714, texture=10.0, rough=0.015, **_FACADE),
}
REPORTED_ON = {
    "boxes 801": BoxSettings(seed=801, texture=12.0, **_SMALL),
    "boxes 802, random views": BoxSettings(seed=802, texture=10.0, **{**_SMALL, "cameras": "random"}),
    "boxes 803, round bodies": BoxSettings(seed=803, texture=8.0, **{**_SMALL, "num_boxes": 5, "num_round": 6}),
    "facade 811": BoxSettings(seed=811, texture=10.0, **_FACADE),
    "facade 812, rough": BoxSettings(seed=812, texture=8.0, rough=0.015, **_FACADE),
    "facade 813, wide": BoxSettings(seed=813, texture=8.0, rough=0.005, **{**_FACADE, "focal": 420.0}),
}
#: Scenes that were run once, when nothing was changed any more.
FRESH = {
    "boxes 901": BoxSettings(seed=901, texture=10.0, **_SMALL),
    "boxes 902, random views": BoxSettings(seed=902, texture=8.0, **{**_SMALL, "cameras": "random"}),
    "boxes 903, round bodies": BoxSettings(seed=903, texture=12.0, **{**_SMALL, "num_boxes": 5, "num_round": 6}),
    "boxes 904, wide": BoxSettings(seed=904, texture=8.0, **{**_SMALL, "focal": 420.0}),
    "facade 911": BoxSettings(seed=911, texture=12.0, **_FACADE),
    "facade 912, rough": BoxSettings(seed=912, texture=10.0, rough=0.012, **_FACADE),
}


def _alike(seed: int) -> dict[str, BoxSettings]:
    """Six scenes of the kinds above, with other seeds."""
    return {
        f"boxes {seed + 1}": BoxSettings(seed=seed + 1, texture=8.0, **_SMALL),
        f"boxes {seed + 2}, random views": BoxSettings(seed=seed + 2, texture=10.0, **{**_SMALL, "cameras": "random"}),
        f"boxes {seed + 3}, round bodies": BoxSettings(
            seed=seed + 3, texture=10.0, **{**_SMALL, "num_boxes": 5, "num_round": 6}
        ),
        f"boxes {seed + 4}, wide": BoxSettings(seed=seed + 4, texture=12.0, **{**_SMALL, "focal": 420.0}),
        f"facade {seed + 11}": BoxSettings(seed=seed + 11, texture=8.0, **_FACADE),
        f"facade {seed + 12}, rough": BoxSettings(seed=seed + 12, texture=12.0, rough=0.012, **_FACADE),
    }


#: Used when directions became a mixture; lines nearly along them were added for the last of these.
LATER = _alike(1100)
#: Run once after that.
LAST = _alike(1200)
#: Run once after the least probability of a line along a direction or on a plane had become 0.85.
UNSEEN = _alike(1400)


def _buildings(seed: int) -> dict[str, BuildingSettings]:
    """One of each kind."""
    return {f"{kind} {seed}": BuildingSettings(kind, seed) for kind in ("room", "wings", "gable", "stairs")}


#: Groups of scenes by the names that the command line takes.
SCENES = {
    "chosen": CHOSEN_ON,
    "reported": REPORTED_ON,
    "fresh": FRESH,
    "later": LATER,
    "last": LAST,
    "unseen": UNSEEN,
    "buildings": _buildings(1),
    "other buildings": _buildings(2),
    "new buildings": _buildings(3),  # run once after planes had been fitted to their members
}
