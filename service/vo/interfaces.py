"""The interfaces that every VO service has: ``/vo/availability``, ``/vo/capabilities`` and ``/vo/tables``.

Citation: IVOA VOSI 1.1 (24 May 2017). The documents are made by ``vo-models``. They need no key, and they contain no
data of owners: a registry or a client reads them before it knows how to log in.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Literal

from fastapi import APIRouter, Request, Response
from pydantic import AnyUrl

from service.http.problems import RouteOptions
from service.http.state import Shared, state_of
from service.operation import faults, states
from service.vo import jobs
from service.vo.lists import LINKS_STANDARD
from service.vo.parameters import base_url
from service.vo.votables import TABLES

if TYPE_CHECKING:
    from pydantic_xml import BaseXmlModel

MEDIA_TYPE, VERSION = "text/xml", "1.1"
BASIC = "ivo://ivoa.net/sso#BasicAA"
router = APIRouter(prefix="/vo", tags=["VO"])


@dataclass(frozen=True)
class Offered:
    """An interface of the service.

    Attributes
    ----------
    use
        "full" for a complete address, "base" for an address to which a client adds parameters or names.
    """

    standard_id: str
    path: str
    description: str
    use: Literal["full", "base"] = "full"
    needs_key: bool = True


OFFERED = (
    Offered(
        "ivo://ivoa.net/std/VOSI#availability",
        "/vo/availability",
        "Whether the service is available.",
        needs_key=False,
    ),
    Offered("ivo://ivoa.net/std/VOSI#capabilities", "/vo/capabilities", "This document.", needs_key=False),
    Offered("ivo://ivoa.net/std/VOSI#tables-1.1", "/vo/tables", "The columns of the lists.", needs_key=False),
    Offered(
        "ivo://ivoa.net/std/UWS#rest-1.1",
        jobs.router.prefix,
        "All jobs: deconvolve images, build and fit PSFs, ...",
        "base",
    ),
    Offered(LINKS_STANDARD, "/vo/links", "The files and services that belong to a product or PSF.", "base"),
    Offered(
        "urn:heliopsf:products", "/vo/products", "The list of products, with columns of ObsCore.", "base"
    ),
    Offered("urn:heliopsf:psfs", "/vo/psfs", "The list of PSFs, with columns of ObsCore.", "base"),
    Offered("urn:heliopsf:cutout", "/vo/cutout", "Cut a circle, box or polygon out of a product.", "base"),
)


def _document(what: str) -> RouteOptions:
    return {
        "response_class": Response,
        "responses": {200: {"content": {MEDIA_TYPE: {}}, "description": f"A document of VOSI 1.1: {what}"}},
    }


@router.get("/availability", summary="VOSI: is the service available?", **_document("the availability"))
async def get_availability(request: Request) -> Response:
    """Whether database, storage, and broker or embedded worker answer, and workers take the jobs; a note for each part
    that does not.
    """
    from vo_models.vosi.availability import Availability  # half a second, and only this request needs it

    state = state_of(request)
    notes = faults(await states(state))
    return _xml(
        Availability(available=not notes, up_since=datetime.fromtimestamp(state.started_at, UTC), note=notes)
    )


@router.get(
    "/capabilities", summary="VOSI: the interfaces of the service", **_document("the list of interfaces")
)
def get_capabilities(request: Request, state: Shared) -> Response:
    """The standard and the address of each interface, and whether it needs a key."""
    from vo_models.vodataservice.models import ParamHTTP
    from vo_models.voresource import AccessURL, Capability, SecurityMethod
    from vo_models.vosi.capabilities import VOSICapabilities

    base, keys = base_url(request), [SecurityMethod(standard_id=AnyUrl(BASIC))] if state.access.keys else []
    listed = [
        Capability(
            standard_id=AnyUrl(offered.standard_id),
            description=offered.description,
            interface=[
                ParamHTTP(
                    role="std",
                    version=VERSION,
                    access_url=[AccessURL(value=AnyUrl(base + offered.path), use=offered.use)],
                    security_method=keys if offered.needs_key else [],
                )
            ],
        )
        for offered in OFFERED
    ]
    return _xml(VOSICapabilities(capability=listed))


@router.get("/tables", summary="VOSI: the columns of the lists", **_document("the tables and their columns"))
def get_tables() -> Response:
    """Name, unit, UCD and meaning of each column of `/vo/products` and `/vo/psfs`."""
    from vo_models.vodataservice.models import DataType, Table, TableParam, TableSchema
    from vo_models.vosi.tables.models import VOSITableSet

    tables = [
        Table(
            table_name=table.name,
            table_type="output",
            description=table.description,
            column=[
                TableParam(
                    column_name=column.name,
                    description=column.description,
                    unit=column.unit,
                    ucd=column.ucd,
                    utype=column.utype,
                    xtype=column.xtype,
                    datatype=DataType(value=column.datatype, arraysize=column.arraysize),
                )
                for column in table.columns
            ],
        )
        for table in TABLES
    ]
    return _xml(VOSITableSet(tableset_schema=[TableSchema(schema_name="default", table=tables)]))


def _xml(made: BaseXmlModel) -> Response:
    content = made.to_xml(skip_empty=True, encoding="UTF-8", xml_declaration=True)
    return Response(content, media_type=MEDIA_TYPE)
