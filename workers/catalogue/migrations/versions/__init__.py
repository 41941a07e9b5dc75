"""One file a revision, in order. One that was released is never changed: a later one mends it.

A revision says in full what it makes and imports nothing of ``workers.catalogue.tables``, which goes on changing. Columns that
it adds have a default in the database, so that workers of the version before go on until they are started again.
"""
