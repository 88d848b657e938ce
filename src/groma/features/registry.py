# SPDX-License-Identifier: BSD-3-Clause
"""Detectors, matchers and retrieval by name: those of groma, those registered, and those of installed packages.

A package offers one by an entry point in the group ``groma.detectors``, ``groma.matchers`` or ``groma.retrieval``; it
is imported on demand. The entry point names a class or function that is called with the settings below, by
keyword, and returns the object. A name that ends in ``:FILE`` stands for any file, which is the setting ``file``.

============================  ==========================================================  =========================
table                         settings                                                    built in
============================  ==========================================================  =========================
:data:`DETECTORS`             ``min_length`` pixels; ``max_segments``, 0 for all          ``lsd``, ``onnx:FILE``
:data:`MATCHERS`              none                                                        ``wide_baseline``, ``flow``
:data:`RETRIEVAL`             none                                                        ``gradients``
============================  ==========================================================  =========================
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from groma.errors import InputError, did_you_mean
from groma.features.contract import ImageRetrieval, SegmentDetector, SegmentMatcher

_T = TypeVar("_T")


class Table(Generic[_T]):
    """Parts of one kind by name.

    Parameters
    ----------
    noun : str
        What a part is, for messages.
    protocol : type
        What a part must have.
    group : str
        Entry points of other packages.
    built_in : dict
        ``module:name`` of each built-in part's class.
    """

    def __init__(self, noun: str, protocol: type[_T], group: str, built_in: dict[str, str]) -> None:
        self.noun, self.group = noun, group
        self._protocol = protocol
        self._factories: dict[str, str | Callable[..., _T]] = {**built_in}

    def register(self, name: str, factory: Callable[..., _T]) -> None:
        """Make a part known by name in this process; ``factory`` takes the settings and returns the part."""
        known = self._factories.get(name, factory)
        if known is not factory and getattr(known, "__module__", "") != factory.__module__:
            raise InputError(f"A {self.noun} named {name!r} is registered already. Choose another name.")
        self._factories[name] = factory

    def names(self) -> list[str]:
        """Return the names of all parts, without importing any."""
        return sorted({*self._factories, *self._installed()})

    def make(self, part: str | _T, **settings: Any) -> _T:
        """Return a part by name, made with settings; a part itself is returned as it is.

        Raises
        ------
        InputError
            If there is none of this name, it cannot be imported or made, or it lacks a method of its protocol.
        """
        made = self._make(part, settings) if isinstance(part, str) else part
        if not isinstance(made, self._protocol):
            methods = [name for name in vars(self._protocol) if not name.startswith("_")]
            raise InputError(
                f"A {self.noun} needs the {'methods' if len(methods) > 1 else 'method'} {' and '.join(methods)}; "
                f"got {type(made).__name__}. See groma.features.contract.{self._protocol.__name__}."
            )
        return made

    def _make(self, name: str, settings: dict[str, Any]) -> Any:
        kind, colon, file = name.partition(":")
        if colon and file and f"{kind}:FILE" in self._factories:
            name, settings = f"{kind}:FILE", settings | {"file": file}
        elif name.endswith(":FILE") or f"{kind}:FILE" in self._factories:
            raise InputError(f"The {self.noun} {kind} needs a file: {kind}:FILE.")
        factory = self._factories.get(name) or self._installed().get(name)
        if factory is None:
            raise InputError(
                f"There is no {self.noun} named {name!r}; choose one of {', '.join(self.names())}."
                + did_you_mean(name, self.names())
            )
        if isinstance(factory, str):
            module, _, attribute = factory.partition(":")
            return getattr(import_module(module), attribute)(**settings)
        if not isinstance(factory, EntryPoint):
            return factory(**settings)
        try:
            return factory.load()(**settings)
        except Exception as error:  # whatever another package raises when it is imported or called
            package = factory.dist.name if factory.dist is not None else factory.module
            raise InputError(
                f"The {self.noun} {name!r} of the package {package} cannot be used: {type(error).__name__}: {error}."
            ) from error

    def _installed(self) -> dict[str, EntryPoint]:
        return {point.name: point for point in entry_points(group=self.group)}


DETECTORS = Table(
    "segment detector",
    SegmentDetector,
    "groma.detectors",
    {"lsd": "groma.features.lsd:LsdDetector", "onnx:FILE": "groma.features.onnx_segments:OnnxDetector"},
)
MATCHERS = Table(
    "segment matcher",
    SegmentMatcher,
    "groma.matchers",
    {
        "wide_baseline": "groma.features.matching.matchers:WideBaselineMatcher",
        "flow": "groma.features.matching.matchers:FlowMatcher",
    },
)
RETRIEVAL = Table(
    "image retrieval", ImageRetrieval, "groma.retrieval", {"gradients": "groma.features.retrieval:GradientRetrieval"}
)
