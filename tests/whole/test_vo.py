"""pyvo from a list of products to its files, on a real service with keys: what an archive or an astronomer does."""

from __future__ import annotations

import io

import numpy as np
import prov
import pytest
import requests
from astropy.io import fits
from pyvo.dal.adhoc import DatalinkQuery, DatalinkResults
from pyvo.dal.query import DALResults

from service.client.http import Client
from tests.conftest import write_image, write_psf
from tests.service.vo.made import OBSERVED, WCS_CARDS
from tests.whole.stack import Stack
from workers.catalogue.access import Scope

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def session(keyed_stack: Stack, tmp_path_factory: pytest.TempPathFactory) -> requests.Session:
    """A session that sends a key as a password, as TOPCAT does, whose owner has one product."""
    folder = tmp_path_factory.mktemp("images")
    key = keyed_stack.key("astronomer-of-products", Scope.READ, Scope.SUBMIT)
    write_image(folder / "image.fits", **OBSERVED, **WCS_CARDS)
    write_psf(folder / "psf.fits")
    with Client(keyed_stack.client.server, key=key) as client:
        psf = client.upload_psf(folder / "psf.fits")
        # The test's PSF names no instrument; only the request connects it with the image.
        client.deconvolve(
            folder / "image.fits", folder / "sharp.fits", psf_id=psf["id"], method="linear", steps=2
        )
    session = requests.Session()
    session.auth = ("anybody", key)
    return session


def test_from_the_list_to_the_file_its_input_its_psf_and_its_provenance(
    keyed_stack: Stack, session: requests.Session
) -> None:
    products = DALResults.from_result_url(f"{keyed_stack.client.server}/vo/products", session=session)
    [product] = products
    assert product["instrument_name"] == "HRI_EUV" and product["method"] == "linear"
    table = DatalinkResults.from_result_url(str(product["access_url"]), session=session)
    by_name = {str(link["local_semantics"]): link for link in table}
    for name, count in (("file", 2), ("input", 1), ("psf", 1)):
        content = session.get(by_name[name].access_url, timeout=60).content
        assert len(content) == by_name[name].content_length
        with fits.open(io.BytesIO(content)) as hdus:
            assert len(hdus) == count
    assert {link.semantics for link in table.bysemantics("#progenitor", include_narrower=False)} == {
        "#progenitor"
    }
    document = prov.read(session.get(by_name["provenance"].access_url, timeout=60).content)
    name = str(product["obs_publisher_did"]).removeprefix("urn:heliopsf:")
    assert len(document.get_record(name)) == 1

    [row] = [link for link in table if link.service_def == "cutout"]
    cutout = DatalinkQuery.from_resource(row, table.get_adhocservice_by_id("cutout"), session=session)
    cutout["CIRCLE"], cutout["FRAME"] = "100 -50 4", "helioprojective"
    answer = session.get(cutout.queryurl, params=dict(cutout), timeout=60)
    with fits.open(io.BytesIO(answer.content)) as hdus:
        assert hdus[0].shape == (17, 17) and np.isfinite(hdus[0].data).all()
