"""Label formats: each is a module with a writer and readers, and a row in `table.py`. They know no project.

Readers raise FormatError for a file that cannot be read or does not follow its format; it names the file and the place
in it. They raise UnitError if the numbers cannot be in the units of the format. Writers are called by `write_dataset`.
"""
