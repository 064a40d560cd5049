"""Typed content of YAML and JSON files: what is wrong in them is said with file, field and the name probably meant."""

from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from swarmtwin.errors import UserError, near_miss

Positive = Annotated[float, Field(gt=0)]


class StrictModel(BaseModel):
    """A typed piece of configuration: unknown fields and wrong types are errors, and it never changes."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, coerce_numbers_to_str=True)

    @classmethod
    def parse(cls, content: Any, where: str) -> Self:
        """Validate `content`, read from `where`.

        Raises:
            UserError: naming `where`, the field, and for an unknown field the one probably meant.
        """
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            first = error.errors()[0]
            field = ".".join(str(part) for part in first["loc"]) or "content"
            if first["type"] == "extra_forbidden":
                *parents, unknown = (str(part) for part in first["loc"])
                known = _field_names(cls, parents)
                raise UserError(f"{where}: unknown field {field!r}: {near_miss(unknown, known)}") from None
            got = "" if first["type"] in ("missing", "value_error") else f", got {first['input']!r}"
            raise UserError(f"{where}: field {field!r}: {first['msg']}{got}") from None


def _field_names(model: type[BaseModel], parents: list[str]) -> list[str]:
    """Return the names of the fields that stand under `parents` in a model; none where those are no model."""
    for parent in parents:
        field = model.model_fields.get(parent)
        if field is None or not (isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)):
            return []
        model = field.annotation
    return [field.alias or name for name, field in model.model_fields.items()]
