"""What the operator decides, read in this one place from ``HELIOPSF_*`` variables.

The defaults are the embedded mode: a local folder, SQLite in it, and a broker without a server.
Scientific choices are never settings: they are parameters of a job.
"""

from __future__ import annotations

import os
from importlib.metadata import version
from pathlib import Path
from typing import Literal

from pydantic import Field, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from psfcore.transit.archive import ArchiveLimits
from workers.contract.queues import Queue, queues_named

EMBEDDED_BROKER = "filesystem://"


class Settings(BaseSettings):
    """Everything the operator sets; each field is also the variable ``HELIOPSF_<FIELD>``."""

    model_config = SettingsConfigDict(env_prefix="HELIOPSF_", frozen=True)

    data_dir: Path = Field(Path("heliopsf-data"), description="folder of files, and of SQLite when embedded")
    store_url: str | None = Field(
        None,
        pattern=r"^s3://[^/]+(/.*)?$",
        description="where files are kept, as s3://bucket/prefix; none means in data_dir",
    )
    store_cache_mib: int = Field(
        20_480, ge=1, description="room in data_dir for copies of files that are kept elsewhere"
    )
    quota_mib: int = Field(
        0, ge=0, description="files that one owner may have kept, unless another is set; 0: no limit"
    )
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
    worker_queues: str = Field(
        ",".join(Queue),
        description="queues that a worker serves, separated by commas; the order is always ours",
    )
    psf_cache_mib: int = Field(
        1024, ge=0, description="memory of a worker process for PSFs prepared, which images that follow share"
    )
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

    bulk_roots: str = Field(
        "", description="folders whose files a bulk may read, with the system's separator between them"
    )
    bulk_output_roots: str = Field("", description="folders below which a bulk may write files, likewise")

    access: Literal["open", "keys"] | None = Field(
        None,
        description="who may ask: all, or who has a key; none means keys unless bound to a loopback address",
    )
    allowed_hosts: str = Field(
        "",
        description="names that the service is called by, separated by commas, besides the loopback ones; * means any",
    )
    max_body_mib: int = Field(16, ge=1, le=1024, description="largest request that is no file")
    reads_per_minute: int = Field(12_000, ge=0, description="of one caller; 0 means no limit")
    submissions_per_minute: int = Field(
        3_000, ge=0, description="uploads and jobs of one caller; 0: no limit"
    )
    upload_mib_per_minute: int = Field(16_384, ge=0, description="sent in by one caller; 0 means no limit")
    streams_per_caller: int = Field(
        32, ge=1, description="streams of events that one caller may have open at a time, of one server"
    )
    stream_s: float = Field(
        3600.0, gt=0, description="longest that a stream of events lasts; its client then comes back"
    )
    max_job_memory_mib: int = Field(
        65_536, ge=1, description="most memory that a job may be expected to need; it is refused else"
    )
    max_job_s: float = Field(
        172_800.0,
        gt=0,
        description="longest that a job may be expected to take, and that one attempt may execute; it is stopped then",
    )

    gap_effects: str = Field(
        "",
        description="modules, or files that end in .py, of effects that a gap's diagnosis tries too, separated by commas; their code is run",
    )

    @field_validator("worker_queues")
    @classmethod
    def _known_queues(cls, names: str) -> str:
        queues_named(names)
        return names

    @classmethod
    def apart(cls, data_dir: Path, *, gap_effects: str = "") -> Settings:
        """Defaults on a folder, whatever the environment says: for work beside any service."""
        return cls(_env_prefix="HELIOPSF_APART_", data_dir=data_dir, gap_effects=gap_effects)

    @property
    def added_effects(self) -> tuple[str, ...]:
        """The modules, or files, of effects that a diagnosis tries beside the library's."""
        return tuple(name.strip() for name in self.gap_effects.split(",") if name.strip())

    @property
    def host_names(self) -> tuple[str, ...]:
        """The names that the operator says the service is called by, in small letters."""
        return tuple(name.strip().lower() for name in self.allowed_hosts.split(",") if name.strip())

    @property
    def queues(self) -> tuple[Queue, ...]:
        """The queues that a worker serves, most urgent first."""
        return queues_named(self.worker_queues)

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
