"""The page's static files."""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter, FastAPI
from fastapi.responses import FileResponse
from starlette.staticfiles import StaticFiles

from annotator.types.errors import ConfigError

PLOTLY = "/assets/vendor/plotly.min.js"


def web_assets() -> Path:
    """The folder `web_assets`: within the package in a wheel, beside it in a clone.

    Raises:
        ConfigError: the folder is missing.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "web_assets", package.parent / "web_assets"):
        if folder.is_dir():
            return folder
    raise ConfigError(f"{package.parent / 'web_assets'}: the page's files are missing; install rcv-annotator again")


def plotly_script() -> Path:
    """The browser script in plotly's Python package."""
    import importlib.util

    spec = importlib.util.find_spec("plotly")
    if spec is None or spec.origin is None:
        raise ConfigError("plotly is not installed; run pip install plotly")
    return Path(spec.origin).parent / "package_data" / "plotly.min.js"


def add_static(app: FastAPI) -> None:
    """Adds GET / for the page, and /assets/... for its files."""
    assets = web_assets()
    router = APIRouter(include_in_schema=False)

    @router.get("/")
    def page() -> FileResponse:
        return FileResponse(assets / "index.html", headers={"Cache-Control": "no-cache"})

    @router.get(PLOTLY)
    def plotly() -> FileResponse:
        return FileResponse(plotly_script(), media_type="text/javascript", headers={"Cache-Control": "max-age=86400"})

    app.include_router(router)
    app.mount("/assets", StaticFiles(directory=assets), name="assets")
