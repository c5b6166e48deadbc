"""The routes of the API, one module per topic; `annotator.web.app.ROUTES` lists the modules."""
