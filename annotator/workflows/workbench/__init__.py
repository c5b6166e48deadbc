"""The workbench page: open frames, drawing, review and corrections."""
