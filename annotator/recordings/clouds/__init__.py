"""Point cloud files in all supported formats, and folders of them."""
