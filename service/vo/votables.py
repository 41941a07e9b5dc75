"""Writes VOTables (IVOA VOTable 1.4, 21 October 2019) with ``astropy.io.votable``.

This module loads the numerical libraries, so the service imports it for the first request that needs it.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from astropy.io.votable import tree

from service.vo.columns import Column
from service.vo.parameters import NO_XML
from workers.settings import software_version

VERSION = "1.4"


@dataclass(frozen=True)
class Input:
    """A parameter of a described service. value: the value that the request must have; empty: the client chooses it.

    ref: the ID of the column that contains the value.
    """

    name: str
    description: str = ""
    value: str = ""
    datatype: str = "char"
    ucd: str | None = None
    ref: str | None = None
    options: tuple[str, ...] = ()


@dataclass(frozen=True)
class Service:
    """A service that a VOTable describes (DataLink 1.1, section 4)."""

    id: str
    description: str
    access_url: str
    inputs: tuple[Input, ...]
    standard_id: str | None = None
    content_type: str | None = None


def table_document(
    name: str,
    columns: Sequence[Column],
    rows: Sequence[Mapping[str, Any]],
    *,
    status: str = "OK",
    infos: Mapping[str, str] | None = None,
    services: Iterable[Service] = (),
) -> bytes:
    """A VOTable with one table. rows: the values by the name of the column; a value that is missing or None is null.

    status: QUERY_STATUS, "OK" or "OVERFLOW". infos: further INFO elements.
    """
    votable = tree.VOTableFile(version=VERSION)
    results = tree.Resource(type="results")
    votable.resources.append(results)
    results.infos.append(tree.Info(name="QUERY_STATUS", value=status))
    notes = {"server_software": f"heliopsf {software_version()}", **(infos or {})}
    results.infos.extend(tree.Info(name=name, value=value) for name, value in notes.items())
    table = tree.TableElement(votable, name=name)
    results.tables.append(table)
    for column in columns:
        table.fields.append(_field(votable, column))
    table.create_arrays(len(rows))
    for at, row in enumerate(rows):
        values = [row.get(column.name) for column in columns]
        table.array[at] = tuple(map(_stored, columns, values))
        table.array.mask[at] = tuple(value is None for value in values)
    votable.resources.extend(_described(votable, service) for service in services)
    return _written(votable)


def error_document(message: str) -> bytes:
    """A VOTable that reports an error (DALI 1.1, section 4.4.1)."""
    votable = tree.VOTableFile(version=VERSION)
    results = tree.Resource(type="results")
    votable.resources.append(results)
    results.infos.append(tree.Info(name="QUERY_STATUS", value="ERROR"))
    results.infos[0].content = NO_XML.sub("?", message)
    return _written(votable)


def _field(votable: tree.VOTableFile, column: Column) -> tree.Field:
    field = tree.Field(
        votable,
        ID=column.name,
        name=column.name,
        datatype=column.datatype,
        arraysize=column.arraysize,
        unit=column.unit,
        ucd=column.ucd,
        utype=column.utype,
        xtype=column.xtype,
    )
    field.description = column.description
    return field


def _stored(column: Column, value: Any) -> Any:
    if column.datatype != "char":
        return 0 if value is None else value
    # The type char holds ASCII; a name or an ID of a request may contain other characters.
    return NO_XML.sub("?", "" if value is None else str(value)).encode("ascii", "backslashreplace").decode()


def _described(votable: tree.VOTableFile, service: Service) -> tree.Resource:
    described = tree.Resource(ID=service.id, type="meta", utype="adhoc:service")
    described.description = service.description
    texts = {
        "standardID": service.standard_id,
        "accessURL": service.access_url,
        "contentType": service.content_type,
    }
    for name, text in texts.items():
        if text is not None:
            described.params.append(
                tree.Param(
                    votable, ID=f"{service.id}-{name}", name=name, datatype="char", arraysize="*", value=text
                )
            )
    inputs = tree.Group(votable, ID=f"{service.id}-inputParams", name="inputParams")
    inputs.entries.extend(_parameter(votable, service.id, one) for one in service.inputs)
    described.groups.append(inputs)
    return described


def _parameter(votable: tree.VOTableFile, service_id: str, one: Input) -> tree.Param:
    parameter = tree.Param(
        votable,
        ID=f"{service_id}-{one.name}",  # otherwise astropy writes the name, which may be the ID of a column
        name=one.name,
        datatype=one.datatype,
        arraysize="*",  # an array of fixed length would need a value, which clients would send
        value=one.value,
        ucd=one.ucd,
        ref=one.ref,
    )
    parameter.description = one.description or None
    parameter.values.options.extend((option, option) for option in one.options)
    return parameter


def _written(votable: tree.VOTableFile) -> bytes:
    content = io.BytesIO()
    votable.to_xml(content, tabledata_format="tabledata")
    return content.getvalue()
