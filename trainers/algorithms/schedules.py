"""Course of a hyper-parameter over a run, as a setting."""

from typing import Any, Literal

from pydantic import (
    BaseModel,
    Field,
    GetJsonSchemaHandler,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

# Which types know which field, and the value it has there when none is given.
_DEFAULTS: dict[str, dict[str, float]] = {
    "power": {"polynomial": 2.0},
    "final_fraction": {"linear": 0.0, "polynomial": 0.0, "exponential": 0.01},
}


class Schedule(BaseModel, frozen=True, extra="forbid"):
    """The course of a hyper-parameter from its initial value at the start of a run to its end.

    In a run file either a mapping, or the type's name alone: `linear` is `{type: linear}`.
    """

    type: Literal["constant", "linear", "polynomial", "exponential"] = Field(
        description="The shape of the course: constant, linear, polynomial (fast at first, then "
        "ever slower when power > 1) or exponential (the same factor for each equal part of the "
        "run)."
    )
    power: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        validate_default=True,
        description="The exponent of a polynomial schedule: 1 is linear. Default 2; no other type "
        "has one.",
    )
    final_fraction: float | None = Field(
        default=None,
        ge=0,
        le=1,
        validate_default=True,
        description="The value at the end of the run as a fraction of the initial one. Default 0 "
        "for linear and polynomial, 0.01 for exponential (which can't reach 0); a constant has "
        "none.",
    )

    @model_validator(mode="before")
    @classmethod
    def _accept_shorthand(cls, data: Any) -> Any:
        return {"type": data} if isinstance(data, str) else data

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        """See pydantic: the mapping or the name alone, for editors."""
        mapping = handler.resolve_ref_schema(handler(core_schema))
        names = mapping["properties"]["type"]["enum"]
        return {"description": mapping.pop("description"), "anyOf": [{"enum": names}, mapping]}

    @field_validator("power", "final_fraction")
    @classmethod
    def _resolve(cls, given: float | None, info: ValidationInfo) -> float | None:
        """Fill in the type's default; refuse what the type has no use for."""
        if "type" not in info.data or info.field_name is None:
            return given  # The type's own error says it all.
        kind, defaults = info.data["type"], _DEFAULTS[info.field_name]
        if given is None:
            return defaults.get(kind)
        if kind not in defaults:
            raise ValueError(
                f"a schedule of type {kind} has no {info.field_name}; leave it out, or choose a "
                f"type that has one: {', '.join(defaults)}"
            )
        if kind == "exponential" and given == 0:
            raise ValueError(
                "an exponential schedule never reaches 0; give a final_fraction above 0, or choose "
                "linear or polynomial"
            )
        return given

    def value(self, initial: float, run_fraction: float) -> float:
        """The scheduled value.

        Args:
            initial: The value at the start of the run.
            run_fraction: The fraction of the run that is over; clamped to [0, 1].
        """
        run_fraction = min(max(run_fraction, 0.0), 1.0)
        if self.final_fraction is None:
            return initial
        if self.type == "exponential":
            # initial * final_fraction ** run_fraction
            return initial * self.final_fraction**run_fraction
        # final + (initial - final) * (1 - run_fraction) ** power, in the form exact at both ends
        weight = (1 - run_fraction) ** (1.0 if self.power is None else self.power)
        return initial * weight + initial * self.final_fraction * (1 - weight)


CONSTANT = Schedule(type="constant")
LINEAR = Schedule(type="linear")
