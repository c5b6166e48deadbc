"""Writes `server.d.ts`: the JSON of the server's API as TypeScript types, from the schema that the server publishes.

    .venv/bin/python scripts/javascript/server_types.py

The types of the server's requests and responses are defined once, as pydantic models in `annotator/web`; `Answers` says
which one each route gives. `tsc` checks the page against them. `scripts/test` writes the file before it calls `tsc`.
"""

from __future__ import annotations

import json
import re
import tempfile
from pathlib import Path
from typing import Any

from annotator.files import write_atomic
from annotator.web.app import create_app
from annotator.web.security import ServerSettings

TARGET = Path(__file__).with_name("server.d.ts")


def main() -> None:
    """Writes the file."""
    with tempfile.TemporaryDirectory() as root:
        api = create_app(ServerSettings(projects_root=Path(root))).openapi()
    schemas = api["components"]["schemas"]
    bodies = [
        route["requestBody"] for path in api["paths"].values() for route in path.values() if "requestBody" in route
    ]
    request_types = _reached(bodies, schemas)
    types = [_declaration(name, schema, name not in request_types) for name, schema in schemas.items()]
    types.append(_answers(api["paths"]))
    text = "// Written by server_types.py.\n\ndeclare namespace Api {\n" + "\n".join(types) + "}\n"
    write_atomic(TARGET, text.encode())


def _reached(start: Any, schemas: dict[str, Any]) -> set[str]:
    """The names of the schemas that a part of the API's description refers to, directly or indirectly."""
    found: set[str] = set()
    waiting = [start]
    while waiting:
        match waiting.pop():
            case {"$ref": str(reference)}:
                name = reference.rpartition("/")[2]
                if name not in found:
                    found.add(name)
                    waiting.append(schemas[name])
            case dict() as schema:
                waiting.extend(schema.values())
            case list() as parts:
                waiting.extend(parts)
    return found


def _declaration(name: str, schema: dict[str, Any], is_answer: bool) -> str:
    """The declaration of one type. Responses have all fields; requests may leave out fields that have a default."""
    text = f"/** {schema['description']} */\n" if "description" in schema else ""
    if "properties" not in schema:
        return f"{text}type {_identifier(name)} = {_type(schema)};\n"
    needed = schema["properties"] if is_answer else schema.get("required", ())
    return f"{text}interface {_identifier(name)} {_type({**schema, 'required': needed})}\n"


def _answers(paths: dict[str, Any]) -> str:
    """The type of each route's answer, such as "GET frames/*": below a project's path, and with "*" for each value."""
    lines = []
    for path, methods in paths.items():
        key = re.sub(r"{\w+}", "*", re.sub(r"^/api/projects/{\w+}/?", "", path))
        for method, route in methods.items():
            match next(answer for code, answer in route["responses"].items() if code.startswith("2")):
                case {"content": {"application/json": {"schema": schema}}} if schema:
                    lines.append(f'  "{method.upper()} {key}": {_type(schema)};\n')
    return "/** What the routes answer. */\ninterface Answers {\n" + "".join(lines) + "}\n"


def _identifier(name: str) -> str:
    return name.replace("-", "")


def _type(schema: dict[str, Any]) -> str:
    """The TypeScript type of a JSON schema, of the kinds that pydantic writes.

    Raises:
        ValueError: if the schema is of another kind.
    """
    if "$ref" in schema:
        return _identifier(schema["$ref"].rpartition("/")[2])
    if "const" in schema:
        return json.dumps(schema["const"])
    if "enum" in schema:
        return " | ".join(map(json.dumps, schema["enum"]))
    for union in ("anyOf", "oneOf"):
        if union in schema:
            return " | ".join(map(_type, schema[union]))
    match schema.get("type"):
        case "array" if "prefixItems" in schema:
            return f"[{', '.join(map(_type, schema['prefixItems']))}]"
        case "array":
            return f"({_type(schema['items'])})[]"
        case "object":
            return _object(schema)
        case "integer" | "number":
            return "number"
        case "string" | "boolean" | "null" as name:
            return str(name)
        case None:
            return "unknown"
    raise ValueError(f"no TypeScript type for {schema}")


def _object(schema: dict[str, Any]) -> str:
    if "properties" not in schema:
        values = schema.get("additionalProperties", True)
        return f"Record<string, {'unknown' if values is True else _type(values)}>"
    needed = set(schema.get("required", ()))
    lines = [f"  {name}{'' if name in needed else '?'}: {_type(of)};" for name, of in schema["properties"].items()]
    return "{\n" + "\n".join(lines) + "\n}"


if __name__ == "__main__":
    main()
