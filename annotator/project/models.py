"""The registry of trained detectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

from pydantic import TypeAdapter
from sqlalchemy import Connection, insert, select, update

from annotator.files import sha256_of
from annotator.project.database.schema import AnyRow, models
from annotator.project.database.store import Store
from annotator.project.records import parsed
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import NotFoundError, ProjectError

_METRICS: TypeAdapter[dict[str, float]] = TypeAdapter(dict[str, float], config={"ser_json_inf_nan": "strings"})
_LABELS: TypeAdapter[tuple[str, ...]] = TypeAdapter(tuple[str, ...])


@dataclass(frozen=True)
class StoredModel:
    """A trained detector.

    Attributes:
        created_ns: when the labels of its training were read, UTC nanoseconds since the epoch.
        box_kind: what its boxes enclose, as in its training data.
        manifest: absolute path of the list of labels that it was trained on, or None.
    """

    id: int
    role: DetectorKind
    path: Path
    created_ns: int
    labels: tuple[str, ...]
    box_kind: BoxKind
    metrics: dict[str, float]
    manifest: Path | None
    fingerprint: str
    active: bool


@dataclass(frozen=True, eq=False)
class Models:
    """Registers models and selects the active one of each role.

    Attributes:
        folder: the project's folder; paths are stored relative to it, so that the project can be moved.
    """

    store: Store
    folder: Path

    def register(
        self,
        role: DetectorKind,
        path: Path,
        *,
        labels: Sequence[str],
        box_kind: BoxKind,
        metrics: Mapping[str, float],
        fingerprint: str,
        manifest: Path | None = None,
        activate: bool = True,
        created_ns: int | None = None,
    ) -> StoredModel:
        """Adds a trained model; by default it becomes the active one of its role.

        Args:
            created_ns: as in `StoredModel`: classes that are renamed later are translated; None = now.
        """
        for file in (path, manifest):
            if file is not None and not file.exists():
                raise ProjectError(f"{file}: is missing; it is required to register the {role} model")
        try:
            sha256 = sha256_of(path)
        except OSError as error:
            raise ProjectError(f"{path}: cannot be read: {error.strerror or error}") from error
        row = {
            "role": role.value,
            "path": self._stored_path(path),
            "created_ns": self.store.clock() if created_ns is None else created_ns,
            "labels": _LABELS.dump_json(tuple(labels)).decode(),
            "box_kind": box_kind.value,
            "metrics": _METRICS.dump_json(dict(metrics)).decode(),
            "manifest": None if manifest is None else self._stored_path(manifest),
            "fingerprint": fingerprint,
            "active": False,
            "sha256": sha256,
        }
        with self.store.write() as connection:
            key = connection.execute(insert(models), row).inserted_primary_key
            assert key is not None  # one row was inserted
            if activate:
                _activate(connection, role, key[0])
            return self._read(connection, key[0])

    def activate(self, model_id: int) -> StoredModel:
        """Makes a model the active one of its role."""
        with self.store.write() as connection:
            _activate(connection, self._read(connection, model_id).role, model_id)
            return self._read(connection, model_id)

    def deactivate(self, role: DetectorKind) -> None:
        """Leaves a role without an active model; the base detector then stands in for a view detector."""
        with self.store.write() as connection:
            connection.execute(update(models).where(models.c.role == role.value).values(active=False))

    def all(self, role: DetectorKind | None = None) -> tuple[StoredModel, ...]:
        """All models (of one role), the oldest first."""
        query = select(models).order_by(models.c.id)
        if role is not None:
            query = query.where(models.c.role == role.value)
        with self.store.read() as connection:
            return tuple(map(self._stored, connection.execute(query)))

    def get(self, model_id: int) -> StoredModel:
        """One model."""
        with self.store.read() as connection:
            return self._read(connection, model_id)

    def active(self, role: DetectorKind) -> StoredModel | None:
        """The active model of a role, or None."""
        return next((model for model in self.all(role) if model.active), None)

    def _stored_path(self, path: Path) -> str:
        inside, folder = path.resolve(), self.folder.resolve()
        if not inside.is_relative_to(folder):
            raise ProjectError(f"{path}: lies outside {folder}; copy it there to register it")
        return inside.relative_to(folder).as_posix()

    def _read(self, connection: Connection, model_id: int) -> StoredModel:
        row = connection.execute(select(models).where(models.c.id == model_id)).first()
        if row is None:
            raise NotFoundError(f"the project has no model with id {model_id}")
        return self._stored(row)

    def _stored(self, row: AnyRow) -> StoredModel:
        folder = self.folder.resolve()
        for path in map(PurePath, filter(None, (row.path, row.manifest))):
            if path.is_absolute() or ".." in path.parts:
                raise ProjectError(
                    f"{self.folder}: its {row.role} model {row.id} lies outside its folder, at {path}; a project has "
                    "its models inside, so ask whoever made this one"
                )
        return StoredModel(
            row.id,
            DetectorKind(row.role),
            folder / row.path,
            row.created_ns,
            parsed(_LABELS.validate_json, row.labels),
            BoxKind(row.box_kind),
            parsed(_METRICS.validate_json, row.metrics),
            None if row.manifest is None else folder / row.manifest,
            row.fingerprint,
            row.active,
        )


def _activate(connection: Connection, role: DetectorKind, model_id: int) -> None:
    # deactivate first: an index forbids two active models of a role
    connection.execute(update(models).where(models.c.role == role.value).values(active=False))
    connection.execute(update(models).where(models.c.id == model_id).values(active=True))
