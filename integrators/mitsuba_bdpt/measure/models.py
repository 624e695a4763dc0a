"""Contents of TOML files, presets and recipes, checked by pydantic."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StrictBool,
    ValidationError,
)
from pydantic import model_validator as validator

from ..errors import CommandError, did_you_mean
from .agreement import FEWEST_RUNS, TILES
from .options import RESOLUTION

Whole = Annotated[int, Field(strict=True, ge=1)]
Text = Annotated[str, Field(min_length=1)]
Names = Annotated[tuple[Text, ...], Field(min_length=1)]
Numbers = Annotated[tuple[Whole, ...], Field(min_length=1)]
Seeds = Annotated[
    Numbers, BeforeValidator(lambda given: given if isinstance(given, list | tuple) else [given])
]
Share = Annotated[float, Field(strict=True, ge=0, le=1)]


class Model(BaseModel):
    """Base of all tables: unknown keys and non-finite numbers are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


ModelT = TypeVar("ModelT", bound=Model)


def checked(kind: type[ModelT], data: Mapping[str, Any], where: object) -> ModelT:
    """Return the model of ``data``; raises ``CommandError`` with ``where`` and key."""
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        texts = []
        for one in error.errors(include_url=False):
            key, text = ".".join(map(str, one["loc"])), one["msg"].removeprefix("Value error, ")
            if one["type"] == "extra_forbidden":
                known = kind.model_fields if len(one["loc"]) == 1 else SceneKeys.model_fields
                text = f"unknown; {did_you_mean(str(one['loc'][-1]), known)}known: {', '.join(known)}"
            texts.append(f"{key}={one['input']!r}: {text}" if key else text)
        raise CommandError(f"{where}: {'; '.join(texts)}") from error


def _of_plugin(value: Any) -> Any:
    if not isinstance(value, bool | int | float | str):
        raise ValueError("must be a number, a text, true or false")
    return value


class Notes(Model):
    """Explanations of a sweep, by scene; ``aside``: integrators whose efficiencies are not compared."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Text]

    aside: tuple[Text, ...] = ()


class Method(Model):
    """An integrator of a preset.

    Keys beside the fields are parameters of the plugin ``type``. ``sampler``: of the sensor; ``match``: equal
    "spp" or "seconds" with the first; ``scenes``: where it is rendered; ``media``: whether these have
    participating media (None: either); ``seeds``: at most so many per budget (None: all).
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Annotated[Any, AfterValidator(_of_plugin)]]

    type: Text
    name: Text = Field(default_factory=lambda data: data.get("type", ""))
    sampler: Text = "independent"
    match: Literal["seconds", "spp"] = "seconds"
    scenes: Names | None = None
    media: StrictBool | None = None
    seeds: Whole | None = None

    @property
    def parameters(self) -> tuple[tuple[str, Any], ...]:
        """The plugin's parameters, with ``type``, sorted by name."""
        return tuple(sorted({"type": self.type, **(self.model_extra or {})}.items()))

    @validator(mode="after")
    def _check(self) -> Method:
        if "max_depth" in (self.model_extra or {}):
            raise ValueError("max_depth of one integrator would compare different images; set it for all")
        return self


class SceneKeys(Model):
    """What a scene of a preset may set for itself: None as in the preset.

    ``spp``: samples per pixel of each budget; ``seeds``: of all budgets, or of each.
    """

    max_depth: Whole | None = None
    spp: Numbers | None = None
    seeds: Seeds | None = None


class PresetFile(Model):
    """A preset; by default compares `bdpt` and `path` in equal time.

    ``clock``: whose seconds decide. ``scenes``: files, names or patterns; None where the command names them.
    """

    scenes: Names | None = None
    resolution: Annotated[int, Field(strict=True, ge=TILES, multiple_of=TILES)] = RESOLUTION
    max_depth: Whole | None = None
    clock: Literal["wall", "processor"] = "wall"
    spp: Numbers = (4, 16, 64)
    seeds: Seeds = (FEWEST_RUNS,)
    scene: dict[str, SceneKeys] = {}
    integrator: Annotated[tuple[Method, ...], Field(min_length=1)] = (
        Method(type="bdpt"),
        Method(type="path", media=False),
        Method(type="volpath", media=True),
    )

    @property
    def methods(self) -> tuple[Method, ...]:
        """The integrators; the first one has its samples, whose time the others match."""
        first, *others = self.integrator
        return first.model_copy(update={"match": "spp"}), *others

    def depth(self, scene: str, own: int) -> int:
        """Return the ``max_depth`` of a scene: its table's, the preset's, or its ``own``."""
        return self.scene.get(scene, SceneKeys()).max_depth or self.max_depth or own

    def budgets(self, scene: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return samples per pixel and seeds of each budget of a scene."""
        own = self.scene.get(scene, SceneKeys())
        spp, seeds = own.spp or self.spp, own.seeds or self.seeds
        return spp, seeds if len(seeds) > 1 else seeds * len(spp)

    @validator(mode="after")
    def _check(self) -> PresetFile:
        for scene in ("", *self.scene):
            spp, seeds = self.budgets(scene)
            if len(set(spp)) < len(spp) or len(seeds) != len(spp):
                of = f" of {scene}" if scene else ""
                raise ValueError(f"spp={list(spp)}{of} must differ, and seeds={list(seeds)} be as many")
        first, names = self.integrator[0], [method.name for method in self.integrator]
        if len(set(names)) < len(names):
            raise ValueError(f"two integrators have the same name: {', '.join(names)}")
        given = first.model_fields_set
        if given & {"scenes", "media", "seeds"} or ("match" in given and first.match == "seconds"):
            raise ValueError(
                f"the first integrator, {first.name!r}, sets the time of the others; it takes neither "
                "scenes nor media nor seeds nor match = 'seconds'"
            )
        return self


class Radiance(Model):
    """A radiance of every pixel that is known: limit - lacks / 2^max_depth."""

    limit: Annotated[float, Field(strict=True)]
    lacks: Annotated[float, Field(strict=True)]


class Recipe(Model):
    """How a scene's reference is made, from PROJECT/references/scenes.toml:

        [glass_caustics]
        by = "bdpt"                 # the default; or "path", where that (with media: `volpath`) converges, or
                                    # "merging", where nothing else samples a part of the light
        merging_radius = 0.125      # of "merging", in pixels; default: 0.25
        windows = [[0.17, 0.57, 0.49, 0.89]]   # left, top, right, bottom, shares of the image: more samples

        [furnace_point]
        radiance = { limit = 1.0, lacks = 2.0 }   # known: limit - lacks / 2^max_depth in every pixel

    Choose windows by the scene, not by observed noise, which would bias the image. Merging blurs, and the
    halves do not show it: docs/development/experiments.md has what is left.
    """

    by: Literal["path", "bdpt", "merging"] = "bdpt"
    merging_radius: Annotated[float, Field(strict=True, gt=0)] = 0.25
    windows: tuple[tuple[Share, Share, Share, Share], ...] = ()
    radiance: Radiance | None = None

    @validator(mode="after")
    def _check(self) -> Recipe:
        if "merging_radius" in self.model_fields_set and self.by != "merging":
            raise ValueError(f"merging_radius={self.merging_radius} needs by = 'merging'")
        for window in self.windows:
            left, top, right, bottom = window
            if not (left < right and top < bottom):
                raise ValueError(f"windows={list(window)} must be left, top, right, bottom")
        return self
