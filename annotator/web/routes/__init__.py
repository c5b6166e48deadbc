"""The API: one module of routes a subject; `annotator.web.app.ROUTES` lists them."""
