"""Label and dataset formats: readers and writers, one module or folder per format."""
