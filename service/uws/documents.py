"""Writes UWS 1.1 documents (job list, job, parameters, results) as XML of the IVOA schema.

Citation: REC-UWS-1.1 (24 October 2016), appendix B, which also defines the order of elements. Times are UTC and end in Z.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any
from xml.etree import ElementTree

from workers.catalogue.tables import JobRow, TermsRow
from workers.catalogue.uws_jobs import JobLine
from workers.contract.kinds import KINDS, Result
from workers.contract.phases import Fault, JobError, Phase

MEDIA_TYPE = "application/xml"
UWS = "http://www.ivoa.net/xml/UWS/v1.0"
XLINK = "http://www.w3.org/1999/xlink"
XSI = "http://www.w3.org/2001/XMLSchema-instance"
VERSION = "1.1"
NO_XML = re.compile(
    "[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]"
)  # characters that XML 1.0 cannot contain

for _prefix, _namespace in (("uws", UWS), ("xlink", XLINK), ("xsi", XSI)):
    ElementTree.register_namespace(_prefix, _namespace)


def job_list(lines: Iterable[JobLine], jobs_url: str) -> bytes:
    """The document of a job list."""
    root = ElementTree.Element(f"{{{UWS}}}jobs", version=VERSION)
    for line in lines:
        reference = {"id": line.id, **_link(f"{jobs_url}/{line.id}")}
        entry = ElementTree.SubElement(root, f"{{{UWS}}}jobref", reference)
        _add(entry, "phase", line.phase)
        if line.run_id is not None:
            _add(entry, "runId", line.run_id)
        _add(entry, "ownerId", line.owner)
        _add(entry, "creationTime", time_text(line.created_at))
    return _written(root)


def job(row: JobRow, terms: TermsRow, quote: float | None, base_url: str) -> bytes:
    """The document of a job."""
    root = ElementTree.Element(f"{{{UWS}}}job", version=VERSION)
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
        summary = ElementTree.SubElement(root, f"{{{UWS}}}errorSummary", type=kind, hasDetail="true")
        _add(summary, "message", error.message)
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
    made = KINDS[row.kind].result
    media_type = "application/json" if made == Result.REPORT else "application/fits"
    return {
        "result": (f"{made}/{row.result_id}/file", media_type),
        "description": (f"{made}/{row.result_id}", "application/json"),
    }


def time_text(seconds: float) -> str:
    """Seconds since 1970 as ISO 8601 in UTC, to the millisecond."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _parameters(row: JobRow) -> ElementTree.Element:
    found = ElementTree.Element(f"{{{UWS}}}parameters")
    for name, value in {"KIND": row.kind, **row.parameters}.items():
        if value is not None:
            _add(found, "parameter", _parameter_text(value)).set("id", name)
    return found


def _parameter_text(value: Any) -> str:
    """A parameter as a form contains it: a text is unchanged, any other value is written as JSON."""
    return value if isinstance(value, str) else json.dumps(value)


def _results(row: JobRow, base_url: str) -> ElementTree.Element:
    found = ElementTree.Element(f"{{{UWS}}}results")
    for name, (address, media_type) in result_addresses(row).items():
        reference = {"id": name, "mime-type": media_type, **_link(base_url + address)}
        ElementTree.SubElement(found, f"{{{UWS}}}result", reference)
    return found


def _link(address: str) -> dict[str, str]:
    return {f"{{{XLINK}}}type": "simple", f"{{{XLINK}}}href": NO_XML.sub("\ufffd", address)}


def _add(parent: ElementTree.Element, name: str, text: str) -> ElementTree.Element:
    element = ElementTree.SubElement(parent, f"{{{UWS}}}{name}")
    # Parameters that were sent as JSON may contain characters that XML cannot contain. Each is written as a replacement
    # character.
    element.text = NO_XML.sub("\ufffd", text)
    return element


def _add_time(parent: ElementTree.Element, name: str, seconds: float | None) -> None:
    if seconds is None:
        ElementTree.SubElement(parent, f"{{{UWS}}}{name}", {f"{{{XSI}}}nil": "true"})
    else:
        _add(parent, name, time_text(seconds))


def _written(root: ElementTree.Element) -> bytes:
    text = ElementTree.tostring(root, encoding="unicode")
    # XML parsers would read a carriage return as a line feed.
    text = text.replace("\r", "&#13;")
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + text.encode()
