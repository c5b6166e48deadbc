"""The browser workbench: a FastAPI application with a JSON API, an event socket, jobs and the page's static files."""
