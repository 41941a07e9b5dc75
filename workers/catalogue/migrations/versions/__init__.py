"""One file per revision, in order. A released revision never changes: a later one corrects it.

A revision contains all that it needs and imports nothing from ``workers.catalogue.tables``, which changes later. New
columns have a default in the database, so that workers of the previous version can go on until they are restarted.
Revision 0010 renames columns: before it runs, workers of the previous version must be stopped.
"""
