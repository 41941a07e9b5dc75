"""One file per revision, in order. A released revision never changes; if it is wrong, a later revision corrects it.

The first revision changes nothing: the tables of a new database are made from ``workers.catalogue.tables``, and the
database then is at the last revision. The later revisions change the tables of existing databases. They import nothing
from ``workers.catalogue.tables``, because those tables change later. New columns have a default in the database, so that
workers of the previous version can continue to work until they are restarted.
"""
