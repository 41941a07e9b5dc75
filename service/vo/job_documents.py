"""Writes UWS 1.1 documents (job list, job, parameters, results) as XML of the IVOA schema.

Citation: REC-UWS-1.1 (24 October 2016), appendix B, which also defines the order of elements. Times are UTC and end in
Z. The models of ``vo-models`` write no element for a time that is not known, and need a class for each set of
parameters; the schema demands these elements, and the parameters differ from kind to kind.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from datetime import UTC, datetime
from xml.etree.ElementTree import Element, SubElement, register_namespace, tostring

from service.vo.parameters import NO_XML
from workers.catalogue.tables import JobRow, TermsRow
from workers.catalogue.uws_jobs import JobLine
from workers.contract.jobs import Fault, JobError, Phase
from workers.contract.kinds import KINDS, ResultType

MEDIA_TYPE = "application/xml"
UWS = "http://www.ivoa.net/xml/UWS/v1.0"
XLINK = "http://www.w3.org/1999/xlink"
XSI = "http://www.w3.org/2001/XMLSchema-instance"
VERSION = "1.1"

for _prefix, _namespace in (("uws", UWS), ("xlink", XLINK), ("xsi", XSI)):
    register_namespace(_prefix, _namespace)


def job_list(lines: Iterable[JobLine], jobs_url: str) -> bytes:
    """The document of a job list."""
    root = Element(f"{{{UWS}}}jobs", version=VERSION)
    for line in lines:
        entry = _add(root, "jobref", id=line.id, **_link(f"{jobs_url}/{line.id}"))
        _add(entry, "phase", line.phase)
        if line.run_id is not None:
            _add(entry, "runId", line.run_id)
        _add(entry, "ownerId", line.owner)
        _add(entry, "creationTime", time_text(line.created_at))
    return _written(root)


def job(row: JobRow, terms: TermsRow, quote: float | None, base_url: str) -> bytes:
    """The document of a job."""
    root = Element(f"{{{UWS}}}job", version=VERSION)
    _add(root, "jobId", row.id)
    if terms.run_id is not None:
        _add(root, "runId", terms.run_id)
    _add(root, "ownerId", row.owner)
    _add(root, "phase", row.phase)
    _add_time(root, "quote", quote)
    _add_time(root, "creationTime", row.created_at)
    _add_time(root, "startTime", row.started_at)
    _add_time(root, "endTime", row.ended_at)
    _add(root, "executionDuration", str(terms.execution_duration_s))
    _add_time(root, "destruction", terms.destruction_at)
    root.append(_parameters(row))
    root.append(_results(row, base_url))
    if row.error is not None:
        error = JobError.model_validate(row.error)
        kind = "transient" if error.fault == Fault.TRANSIENT else "fatal"
        _add(_add(root, "errorSummary", type=kind, hasDetail="true"), "message", error.message)
    return _written(root)


def parameters(row: JobRow) -> bytes:
    """The document of a job's parameters."""
    return _written(_parameters(row))


def results(row: JobRow, base_url: str) -> bytes:
    """The document of a job's results."""
    return _written(_results(row, base_url))


def result_addresses(row: JobRow) -> dict[str, tuple[str, str]]:
    """The address and media type of each result, by its name; empty until the job is COMPLETED."""
    if row.phase != Phase.COMPLETED or row.result_id is None:
        return {}
    result = KINDS[row.kind].result
    media_type = "application/json" if result == ResultType.REPORT else "application/fits"
    return {
        "result": (f"{result}/{row.result_id}/file", media_type),
        "description": (f"{result}/{row.result_id}", "application/json"),
    }


def time_text(seconds: float) -> str:
    """Seconds since 1970 as ISO 8601 in UTC, to the millisecond."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _parameters(row: JobRow) -> Element:
    root = Element(f"{{{UWS}}}parameters")
    for name, value in {"KIND": row.kind, **row.parameters}.items():
        if value is not None:
            # As a form contains it: a text is unchanged, any other value is written as JSON.
            _add(root, "parameter", value if isinstance(value, str) else json.dumps(value), id=name)
    return root


def _results(row: JobRow, base_url: str) -> Element:
    root = Element(f"{{{UWS}}}results")
    for name, (address, media_type) in result_addresses(row).items():
        _add(root, "result", **{"id": name, "mime-type": media_type, **_link(base_url + address)})
    return root


def _link(address: str) -> dict[str, str]:
    return {f"{{{XLINK}}}type": "simple", f"{{{XLINK}}}href": NO_XML.sub("\ufffd", address)}


def _add(parent: Element, name: str, text: str | None = None, **attributes: str) -> Element:
    element = SubElement(parent, f"{{{UWS}}}{name}", attributes)
    if text is not None:
        # Parameters that were sent as JSON may contain characters that XML cannot contain.
        element.text = NO_XML.sub("\ufffd", text)
    return element


def _add_time(parent: Element, name: str, seconds: float | None) -> None:
    if seconds is None:
        _add(parent, name, **{f"{{{XSI}}}nil": "true"})
    else:
        _add(parent, name, time_text(seconds))


def _written(root: Element) -> bytes:
    # XML parsers would read a carriage return as a line feed.
    text = tostring(root, encoding="unicode").replace("\r", "&#13;")
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + text.encode()
