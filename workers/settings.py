"""What the operator decides, read in this one place from ``HELIOPSF_*`` variables.

The defaults are the embedded mode: a local folder, SQLite in it, and a broker without a server.
Scientific choices are never settings: they are parameters of a job.
"""

from __future__ import annotations

import os
from importlib.metadata import version
from pathlib import Path
from typing import Literal

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict

from psfcore.transit.archive import ArchiveLimits

EMBEDDED_BROKER = "filesystem://"


class Settings(BaseSettings):
    """Everything the operator sets; each field is also the variable ``HELIOPSF_<FIELD>``."""

    model_config = SettingsConfigDict(env_prefix="HELIOPSF_", frozen=True)

    data_dir: Path = Field(Path("heliopsf-data"), description="folder of files, and of SQLite when embedded")
    database_url: str | None = Field(None, description="SQLAlchemy URL; none means SQLite in data_dir")
    broker_url: str = Field(EMBEDDED_BROKER, description="Celery broker; the default needs no server")
    max_upload_mib: int = Field(160, ge=1, le=65_536, description="largest file taken, as sent")
    max_pixels: int = Field(4096 * 4096, ge=256, description="largest image or PSF taken, by its header")
    max_transit_mib: int = Field(4096, ge=1, le=1_048_576, description="largest transit taken, as sent")
    max_transit_unpacked_mib: int = Field(
        8192, ge=1, le=1_048_576, description="most that may come out of a transit's archive"
    )
    worker_processes: int = Field(1, ge=1)
    worker_threads: int | None = Field(None, ge=1, description="none means cores / worker_processes")
    heartbeat_s: float = Field(2.0, gt=0, description="how often a running job says that it is alive")
    lease_s: float = Field(15.0, gt=0, description="silence after which a running job's worker is given up")
    reconcile_s: float = Field(2.0, gt=0, description="how often the job table is compared with the broker")
    resubmit_s: float = Field(30.0, gt=0, description="first wait before a queued job is submitted again")
    max_attempts: int = Field(3, ge=1, description="starts after which a job is an error")
    stop_s: float = Field(
        15.0,
        ge=0,
        description="how long requests and jobs may go on after SIGTERM; then jobs are handed back",
    )
    log_format: Literal["text", "json"] | None = Field(
        None, description="form of the logs on standard error; none means text on a terminal, else json"
    )

    uws_max_wait_s: float = Field(
        50.0, ge=0, le=3600, description="longest that a UWS client is kept waiting"
    )
    uws_max_execution_s: int = Field(
        604_800, ge=0, lt=2**31, description="longest that a UWS client's job may execute; 0 means no limit"
    )
    uws_max_keep_s: int = Field(
        2_592_000, ge=1, lt=2**31, description="longest that a UWS client may have a job kept"
    )

    gap_effects: str = Field(
        "",
        description="modules of effects that a gap's diagnosis tries too, separated by commas; their code is run",
    )

    @classmethod
    def apart(cls, data_dir: Path, *, gap_effects: str = "") -> Settings:
        """Defaults on a folder, whatever the environment says: for work beside any service."""
        return cls(_env_prefix="HELIOPSF_APART_", data_dir=data_dir, gap_effects=gap_effects)

    @property
    def added_effects(self) -> tuple[str, ...]:
        """The modules, or files, of effects that a diagnosis tries beside the library's."""
        return tuple(name.strip() for name in self.gap_effects.split(",") if name.strip())

    @property
    def embedded(self) -> bool:
        """True where the broker is a folder, so that ``heliopsf serve`` starts the worker itself."""
        return self.broker_url == EMBEDDED_BROKER

    @property
    def catalogue_url(self) -> str:
        """The database's URL, with SQLite in the data folder as default."""
        if self.database_url is None:
            return f"sqlite:///{self.data_dir.resolve() / 'catalogue.sqlite'}"
        # A bare postgresql:// would ask for psycopg2; the project brings psycopg 3.
        return self.database_url.replace("postgresql://", "postgresql+psycopg://", 1)

    @property
    def threads(self) -> int:
        """Threads of one worker process: cores / worker processes, so that workers share the machine."""
        return self.worker_threads or max(1, cores() // self.worker_processes)

    @property
    def gone_s(self) -> float:
        """Time after SIGTERM at which a worker is gone, whatever its job does.

        It looks at each heartbeat whether its job is to be handed back; then Celery has some seconds to end in order.
        """
        return self.stop_s + self.heartbeat_s + 6.0

    @property
    def presence_s(self) -> float:
        """How often a worker says that it is there, at work or not: often enough for its lease."""
        return max(self.heartbeat_s, self.lease_s / 3)

    @property
    def max_upload_bytes(self) -> int:
        """Largest file taken, in bytes."""
        return self.max_upload_mib * 2**20

    @property
    def max_transit_bytes(self) -> int:
        """Largest transit taken, in bytes."""
        return self.max_transit_mib * 2**20

    @property
    def archive_limits(self) -> ArchiveLimits:
        """Bounds on what comes out of a transit's archive."""
        return ArchiveLimits(max_bytes=self.max_transit_unpacked_mib * 2**20)


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def software_version() -> str:
    """Version of the installed package, as products name it."""
    return version("heliopsf")


def library_versions() -> dict[str, str]:
    """Versions of the libraries that a product's numbers come from."""
    return {name: version(name) for name in ("numpy", "scipy", "numba", "astropy")}
