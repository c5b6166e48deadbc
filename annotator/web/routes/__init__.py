"""The routes of the API, one module per topic; `annotator.web.app.ROUTES` lists them, and that of the 3D view."""
