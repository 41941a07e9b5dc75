"""VOTables (IVOA VOTable 1.4, 21 October 2019): the columns of the lists of products and PSFs and of DataLink tables,
and their documents, which ``astropy.io.votable`` writes.

Citation: IVOA ObsCore 1.1 (9 May 2017), tables 6 and 7; IVOA DataLink 1.1 (15 December 2023), section 3.2. Every list
has the columns of ObsCore that are mandatory, in the same order, so that a catalogue can ingest it; columns of this
service follow. A value is null if the service does not know it. The position on the sky is always null: ObsCore gives
it in equatorial coordinates, and the Sun moves in them.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from service.vo.parameters import NO_XML
from workers.settings import software_version

if TYPE_CHECKING:
    from astropy.io.votable import tree

VERSION = "1.4"


@dataclass(frozen=True)
class Column:
    """A column of a table: its VOTable type, its meaning, and its names in the models of the IVOA."""

    name: str
    description: str
    datatype: str = "char"
    unit: str | None = None
    ucd: str | None = None
    utype: str | None = None
    xtype: str | None = None

    @property
    def arraysize(self) -> str | None:
        """The length of the value: any length for a text."""
        return "*" if self.datatype == "char" else None


@dataclass(frozen=True)
class Table:
    """A list of the service."""

    name: str
    description: str
    columns: tuple[Column, ...]


def _obscore(
    name: str,
    utype: str,
    ucd: str,
    description: str,
    datatype: str = "char",
    unit: str | None = None,
    xtype: str | None = None,
) -> Column:
    return Column(name, description, datatype, unit, ucd, f"obscore:{utype}", xtype)


OBSCORE = (
    _obscore("dataproduct_type", "ObsDataset.dataProductType", "meta.code.class", "Type of the data: image"),
    _obscore(
        "calib_level",
        "ObsDataset.calibLevel",
        "meta.code;obs.calib",
        "Level of the calibration; 3: a derived product",
        "int",
    ),
    _obscore("obs_collection", "DataID.collection", "meta.id", "Collection to which the data belong"),
    _obscore(
        "obs_id",
        "DataID.observationID",
        "meta.id",
        "Id of the observation: the SHA-256 of the input image; for a PSF its id",
    ),
    _obscore(
        "obs_publisher_did",
        "Curation.publisherDID",
        "meta.ref.ivoid",
        "Id of the product or PSF for /vo/links and /vo/cutout",
    ),
    _obscore(
        "access_url",
        "Access.reference",
        "meta.ref.url",
        "Address of the DataLink table with all files of the product or PSF",
    ),
    _obscore("access_format", "Access.format", "meta.code.mime", "Media type at access_url"),
    _obscore(
        "access_estsize", "Access.size", "phys.size;meta.file", "Size of the FITS file", "long", "kbyte"
    ),
    _obscore("target_name", "Target.name", "meta.id;src", "Observed object"),
    _obscore(
        "s_ra",
        "Char.SpatialAxis.Coverage.Location.Coord.Position2D.Value2.C1",
        "pos.eq.ra",
        "Right ascension; null",
        "double",
        "deg",
    ),
    _obscore(
        "s_dec",
        "Char.SpatialAxis.Coverage.Location.Coord.Position2D.Value2.C2",
        "pos.eq.dec",
        "Declination; null",
        "double",
        "deg",
    ),
    _obscore(
        "s_fov",
        "Char.SpatialAxis.Coverage.Bounds.Extent.diameter",
        "phys.angSize;instr.fov",
        "Width or height of the field of view, whichever is larger",
        "double",
        "deg",
    ),
    _obscore(
        "s_region",
        "Char.SpatialAxis.Coverage.Support.Area",
        "pos.outline;obs.field",
        "Region on the sky; null",
    ),
    _obscore(
        "s_resolution",
        "Char.SpatialAxis.Resolution.Refval.value",
        "pos.angResolution",
        "Angular resolution; null",
        "double",
        "arcsec",
    ),
    _obscore("s_xel1", "Char.SpatialAxis.numBins1", "meta.number", "Number of columns", "long"),
    _obscore("s_xel2", "Char.SpatialAxis.numBins2", "meta.number", "Number of rows", "long"),
    _obscore(
        "t_min",
        "Char.TimeAxis.Coverage.Bounds.Limits.StartTime",
        "time.start;obs.exposure",
        "Start of the exposure (MJD); for a PSF start of its validity",
        "double",
        "d",
    ),
    _obscore(
        "t_max",
        "Char.TimeAxis.Coverage.Bounds.Limits.StopTime",
        "time.end;obs.exposure",
        "End of the exposure (MJD); for a PSF end of its validity",
        "double",
        "d",
    ),
    _obscore(
        "t_exptime",
        "Char.TimeAxis.Coverage.Support.Extent",
        "time.duration;obs.exposure",
        "Exposure time",
        "double",
        "s",
    ),
    _obscore(
        "t_resolution",
        "Char.TimeAxis.Resolution.Refval.value",
        "time.resolution",
        "Resolution in time: the exposure time",
        "double",
        "s",
    ),
    _obscore("t_xel", "Char.TimeAxis.numBins", "meta.number", "Number of times", "long"),
    _obscore(
        "em_min",
        "Char.SpectralAxis.Coverage.Bounds.Limits.LoLimit",
        "em.wl;stat.min",
        "Wavelength that names the channel",
        "double",
        "m",
    ),
    _obscore(
        "em_max",
        "Char.SpectralAxis.Coverage.Bounds.Limits.HiLimit",
        "em.wl;stat.max",
        "Wavelength that names the channel",
        "double",
        "m",
    ),
    _obscore(
        "em_res_power",
        "Char.SpectralAxis.Resolution.ResolPower.refVal",
        "spect.resolution",
        "Spectral resolving power; null",
        "double",
    ),
    _obscore("em_xel", "Char.SpectralAxis.numBins", "meta.number", "Number of wavelengths", "long"),
    _obscore("o_ucd", "Char.ObservableAxis.ucd", "meta.ucd", "UCD of the pixels"),
    _obscore(
        "pol_states",
        "Char.PolarizationAxis.stateList",
        "meta.code;phys.polarization",
        "Polarization states; null",
    ),
    _obscore(
        "pol_xel", "Char.PolarizationAxis.numBins", "meta.number", "Number of polarization states", "long"
    ),
    _obscore(
        "facility_name",
        "Provenance.ObsConfig.Facility.name",
        "meta.id;instr.tel",
        "Observatory or spacecraft",
    ),
    _obscore("instrument_name", "Provenance.ObsConfig.Instrument.name", "meta.id;instr", "Instrument"),
    _obscore("obs_title", "DataID.title", "meta.title;obs", "Title"),
    _obscore(
        "obs_creation_date",
        "DataID.date",
        "time.creation;meta.dataset",
        "Time at which the product or PSF was made",
        xtype="timestamp",
    ),
    _obscore("obs_creator_name", "DataID.creator", "meta.id", "Owner"),
)
_FILE = (
    Column("file_url", "Address of the FITS file", ucd="meta.ref.url;meta.fits"),
    Column("file_sha256", "SHA-256 of the FITS file", ucd="meta.checksum"),
    Column("provenance_url", "Address of the lineage as W3C PROV-JSON", ucd="meta.ref.url"),
)
PRODUCTS = Table(
    "products",
    "Products: deconvolved images",
    (
        *OBSCORE,
        *_FILE,
        Column("image_id", "SHA-256 of the input image", ucd="meta.id"),
        Column("psf_id", "Id of the PSF", ucd="meta.id;instr.det.psf"),
        Column("psf_version", "Version of the PSF", ucd="meta.version"),
        Column("method", "Method of the deconvolution", ucd="meta.id"),
        Column(
            "artefact_score",
            "Artefact score: large where a product shows signs of over-deconvolution",
            "double",
            ucd="stat.value",
        ),
    ),
)
PSFS = Table(
    "psfs",
    "PSFs: point-spread functions of instruments",
    (
        *OBSCORE,
        *_FILE,
        Column("name", "Name of the PSF", ucd="meta.id;meta.main"),
        Column("version", "Version of the PSF in its series", ucd="meta.version"),
        Column("status", "draft, certified or deprecated", ucd="meta.code.status"),
        Column("kind", "total, a component such as diffraction, or uploaded", ucd="meta.code.class"),
        Column("origin", "built, fitted, interpolated or uploaded", ucd="meta.code.class"),
        Column("successor", "Id of the PSF to use instead of a deprecated PSF", ucd="meta.id"),
    ),
)
TABLES = (PRODUCTS, PSFS)
LINKS = (
    Column("ID", "Id of the product or PSF, as the request gives it", ucd="meta.id;meta.main"),
    Column("access_url", "Address", ucd="meta.ref.url"),
    Column("service_def", "ID of the description of the service, below", ucd="meta.ref"),
    Column("error_message", "Why there is no link", ucd="meta.code.error"),
    Column(
        "semantics", "Meaning of the link: a term of http://www.ivoa.net/rdf/datalink/core", ucd="meta.code"
    ),
    Column("description", "Description", ucd="meta.note"),
    Column("content_type", "Media type", ucd="meta.code.mime"),
    Column("content_length", "Size", "long", unit="byte", ucd="phys.size;meta.file"),
    Column("local_semantics", "Name of the link in this service", ucd="meta.code"),
    Column("link_auth", "Whether the address needs a key", ucd="meta.code"),
)


# --- VOTables -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Input:
    """A parameter of a described service.

    Attributes
    ----------
    value
        The value that the request must have; empty: the client chooses the value.
    ref
        The ID of the column that contains the value.
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
    rows: Sequence[Mapping[str, object]],
    *,
    status: str = "OK",
    infos: Mapping[str, str] | None = None,
    services: Iterable[Service] = (),
) -> bytes:
    """A VOTable with one table.

    Parameters
    ----------
    rows
        The values of each row by the name of the column; a value that is missing or None is null.
    status
        QUERY_STATUS, "OK" or "OVERFLOW".
    infos
        The values of further INFO elements, by name.
    services
        The services that the document describes.
    """
    from astropy.io.votable import tree

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
    from astropy.io.votable import tree

    votable = tree.VOTableFile(version=VERSION)
    results = tree.Resource(type="results")
    votable.resources.append(results)
    results.infos.append(tree.Info(name="QUERY_STATUS", value="ERROR"))
    results.infos[0].content = NO_XML.sub("?", message)
    return _written(votable)


def _field(votable: tree.VOTableFile, column: Column) -> tree.Field:
    from astropy.io.votable import tree

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


def _stored(column: Column, value: object) -> object:
    if column.datatype != "char":
        return 0 if value is None else value
    # The type char holds ASCII; a name or an ID of a request may contain other characters.
    return NO_XML.sub("?", "" if value is None else str(value)).encode("ascii", "backslashreplace").decode()


def _described(votable: tree.VOTableFile, service: Service) -> tree.Resource:
    from astropy.io.votable import tree

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
    from astropy.io.votable import tree

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
