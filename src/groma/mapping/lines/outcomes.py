# SPDX-License-Identifier: BSD-3-Clause
"""What can become of a segment while lines are mapped, and how to say it."""

from __future__ import annotations

from enum import IntEnum


class Outcome(IntEnum):
    """What became of a segment. Members are in the order of the stages."""

    #: It observes a line.
    MAPPED = 0
    #: It observes a line, found by projecting the line, not by its own proposals.
    RECOVERED = 1
    #: Shorter than ``min_length``, or where the camera cannot undo its distortion.
    TOO_SHORT = 2
    #: Its image shares too few points with others.
    NO_NEIGHBOR = 3
    #: No segment of a neighbour can be the same line: none in the epipolar beam at a plausible depth, or none matched.
    NO_MATCH = 4
    #: Every candidate leaves the depth undetermined: the line runs along the epipolar lines of all neighbours.
    DEGENERATE = 5
    #: Too few neighbours agree on a place.
    NO_SUPPORT = 6
    #: Another place has about the same support.
    AMBIGUOUS = 7
    #: It has a place, but no other segment has the same.
    NOT_LINKED = 8
    #: It was part of a line, and its distance to it failed the test.
    OUTLIER = 9
    #: Its line is seen in fewer than ``min_images`` images.
    FEW_IMAGES = 10
    #: Its line is too uncertain for its distance, or for the usual one, or would be without one of its images.
    UNCERTAIN = 11
    #: No segment of its line is as long as ``min_longest``.
    SHORT_LINE = 12
    #: Its line is made of segments of a kind that is seldom found again, or few of the images that should show it do:
    #: ``min_repeatability``.
    TEXTURE = 13
    #: A line of more images explains what the images of its line show.
    REPEATED = 14


#: What is said of so many segments.
WORDS = {
    Outcome.TOO_SHORT: "fell short of the least length, or lay where the lens model does not hold",
    Outcome.NO_NEIGHBOR: "lay in images that share too few points with others",
    Outcome.NO_MATCH: "had no counterpart in any neighbouring image",
    Outcome.DEGENERATE: "ran along the epipolar lines of all neighbours, which leaves the depth undetermined",
    Outcome.NO_SUPPORT: "had no place in space on which neighbouring images agree",
    Outcome.AMBIGUOUS: "had two places in space that fit equally well",
    Outcome.NOT_LINKED: "had a place in space that no other segment shares",
    Outcome.OUTLIER: "did not fit the line on which other segments lie",
    Outcome.FEW_IMAGES: "lay on lines that too few images see",
    Outcome.UNCERTAIN: "lay on lines too uncertain for their distance",
    Outcome.SHORT_LINE: "lay on lines that only short segments show",
    Outcome.REPEATED: "lay on lines where an image cannot tell them from a line that more images see",
    Outcome.TEXTURE: "lay on lines of short, weak segments that few of the images show that should: likely texture",
}

#: What would help; segments of texture are left out on purpose.
REMEDIES = {
    Outcome.TOO_SHORT: "a smaller least length (--min-length), or larger images",
    Outcome.NO_NEIGHBOR: "photographs that overlap more, or a model with more points",
    Outcome.NO_MATCH: "a model with the right poses, calibration and image size; sharp photographs",
    Outcome.DEGENERATE: "photographs from another height or side: the camera moved along these lines, or hardly",
    Outcome.NO_SUPPORT: "more photographs of the same parts; or, where points do not fit, better poses and calibration "
    "(--refine-intrinsics estimates a given one): an error of a few pixels leaves no agreement",
    Outcome.AMBIGUOUS: "more photographs, or matches from elsewhere (--line-matches): the structure repeats itself",
    Outcome.NOT_LINKED: "more photographs of the same parts",
    Outcome.OUTLIER: "better poses and calibration (--refine-intrinsics estimates a given one)",
    Outcome.FEW_IMAGES: "more photographs of the same parts",
    Outcome.UNCERTAIN: "photographs from further apart",
    Outcome.SHORT_LINE: "larger images",
    Outcome.REPEATED: "photographs from nearer, which show edges close to each other as two",
}
