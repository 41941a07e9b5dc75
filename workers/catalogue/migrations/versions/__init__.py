"""One file per revision, in order. A released revision never changes; if it is wrong, a later revision corrects it.

A revision imports nothing from ``workers.catalogue.tables``, because those tables change later. New columns have a
default in the database, so that workers of the previous version can continue to work until they are restarted. Revision
0010 renames columns: before it runs, workers of the previous version must be stopped.
"""
