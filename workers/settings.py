"""Settings of the operator. Only this module reads ``HELIOPSF_*`` variables.

The defaults give the embedded mode: a local folder that contains an SQLite database, and a broker that needs no server.
Scientific choices are never settings; they are parameters of a job.
"""

from __future__ import annotations

from importlib.metadata import version
from ipaddress import ip_network
from pathlib import Path
from typing import Literal

from platformdirs import user_data_path
from pydantic import Field, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from psfcore import software_version as software_version
from psfcore.fits.blocks import FitsLimits
from psfcore.transit.admission import ArchiveLimits
from workers.contract.jobs import Queue, queues_named
from workers.machine import cores, memory_bytes

EMBEDDED_BROKER = "filesystem://"
KEPT_KINDS = ("image", "transit", "product", "report", "job", "bulk")
_KEPT = rf"([a-z0-9][a-z0-9._-]*/)?({'|'.join(KEPT_KINDS)})=[1-9][0-9]{{0,4}}"
MEMORY_OF_JOBS = 0.8  # share of the memory for jobs; the rest is for the system, the server and the database


class Settings(BaseSettings):
    """All settings; the environment variable ``HELIOPSF_<FIELD>`` sets a field."""

    model_config = SettingsConfigDict(env_prefix="HELIOPSF_", frozen=True)

    data_dir: Path = Field(
        default_factory=lambda: user_data_path("heliopsf", appauthor=False),
        description="folder of stored files and, by default, of the SQLite database; default: the user's data folder, "
        "on Linux `~/.local/share/heliopsf`",
    )
    store_url: str | None = Field(
        None,
        pattern=r"^s3://[^/]+(/.*)?$",
        description="object store of files, s3://bucket/prefix; default: files are stored in data_dir",
    )
    store_cache_mib: int = Field(
        20_480, ge=1, description="space in data_dir for cached copies of files in the object store, MiB"
    )
    quota_mib: int = Field(
        0,
        ge=0,
        description="largest size of an owner's stored files, MiB; 0: unlimited; `heliopsf store quota` sets another "
        "limit for an owner",
    )
    keep_days: str = Field(
        "",
        pattern=rf"^$|^({_KEPT})(, *{_KEPT})*$",
        description="for how many days things are kept, by kind and owner, for example "
        "`product=365,image=90,ann/product=30`; "
        f"older ones are deleted once an hour; kinds: {', '.join(KEPT_KINDS)}; default: everything is kept",
    )
    keep_dry_run: bool = Field(
        True, description="only log what keep_days would delete, by owner and kind; false: delete it"
    )
    min_free_mib: int = Field(
        256,
        ge=0,
        description="minimum free space on the disk that contains data_dir, MiB; if less is free, uploads and jobs "
        "are refused, and /readyz answers 503",
    )
    database_url: str | None = Field(
        None, description="SQLAlchemy URL of the database; default: SQLite in data_dir"
    )
    broker_url: str = Field(
        EMBEDDED_BROKER, description="URL of the Celery broker; the default needs no server"
    )
    max_upload_mib: int = Field(160, ge=1, le=65_536, description="largest uploaded image, MiB")
    max_pixels: int = Field(
        4096 * 4096, ge=256, description="largest number of pixels of an image, as its header declares"
    )
    max_psf_mib: int = Field(
        640,
        ge=1,
        le=65_536,
        description="largest uploaded PSF file, MiB; default: room for 8192 x 8192 doubles",
    )
    max_psf_pixels: int = Field(
        8192 * 8192, ge=256, description="largest number of pixels of a PSF, as its header declares"
    )
    max_transit_mib: int = Field(4096, ge=1, le=1_048_576, description="largest uploaded transit, MiB")
    max_transit_unpacked_mib: int = Field(
        8192, ge=1, le=1_048_576, description="largest unpacked size of a transit, MiB"
    )
    worker_processes: int = Field(1, ge=1, description="processes of a worker; each runs one job at a time")
    worker_threads: int | None = Field(
        None, ge=1, description="threads of a worker process; default: cores / worker_processes"
    )
    worker_queues: str = Field(
        ",".join(Queue),
        description="queues that a worker serves, separated by commas; the order in this list does not change their "
        "priority",
    )
    psf_cache_mib: int = Field(
        1024, ge=0, description="memory of a worker process for prepared PSFs, which later jobs reuse, MiB"
    )
    heartbeat_s: float = Field(2.0, gt=0, description="interval between heartbeats of a running job, s")
    lease_s: float = Field(
        15.0,
        gt=0,
        description="time without a heartbeat after which a worker counts as lost and its job is queued again, s",
    )
    reconcile_s: float = Field(
        2.0,
        gt=0,
        description="interval between two searches for queued jobs that the broker may have lost, s",
    )
    resubmit_s: float = Field(
        30.0, gt=0, description="time after which a queued job is sent to the broker for the second time, s"
    )
    cancel_s: float = Field(
        10.0,
        gt=0,
        description="if a job was cancelled or took too long but does not stop, its worker process is ended and "
        "replaced after this time, s",
    )
    max_attempts: int = Field(3, ge=1, description="number of attempts after which a job fails")
    stop_s: float = Field(
        15.0,
        ge=0,
        description="time after SIGTERM in which running requests and jobs may finish, s; then unfinished jobs are "
        "queued again",
    )
    traces_url: str | None = Field(
        None,
        pattern=r"^https?://\S+$",
        description="address to which traces are sent by OTLP over HTTP, such as http://127.0.0.1:4318/v1/traces "
        "(needs the extra `traces`); default: no traces",
    )
    log_format: Literal["text", "json"] | None = Field(
        None, description="format of the logs; default: text on a terminal, otherwise json"
    )
    log_file: Path | None = Field(
        None,
        description="file of the logs, which all servers and workers of a machine may share; default: standard error",
    )
    log_file_mib: int = Field(
        100, ge=1, description="size at which the log file is renamed to FILE.1 and a new one begins, MiB"
    )
    log_files: int = Field(5, ge=1, description="number of renamed log files that are kept")

    uws_max_wait_s: float = Field(
        50.0, ge=0, le=3600, description="longest time that a UWS request with WAIT may wait, s"
    )
    uws_max_execution_s: int = Field(
        604_800,
        ge=0,
        lt=2**31,
        description="longest execution time that a UWS client can set, s; 0: unlimited",
    )
    uws_max_keep_s: int = Field(
        2_592_000, ge=1, lt=2**31, description="longest time until a UWS job is destroyed, s"
    )

    bulk_roots: str = Field("", description="folders whose files a bulk run may read, separated as in PATH")
    bulk_output_roots: str = Field(
        "", description="folders below which a bulk run may write files, separated as in PATH"
    )

    access: Literal["open", "keys"] | None = Field(
        None,
        description="who may use the service: `open`: everybody; `keys`: clients with a key; default: `open` on a "
        "loopback address, otherwise `keys`",
    )
    session_days: float = Field(
        30.0,
        gt=0,
        le=400,
        description="longest duration of a login in a browser, days; a login never lasts longer than its key",
    )
    allowed_hosts: str = Field(
        "",
        description="host names of the service besides localhost, separated by commas; *: any name",
    )
    trusted_proxies: str = Field(
        "",
        description="addresses or networks of reverse proxies, separated by commas; the service believes their "
        "headers X-Forwarded-For and X-Forwarded-Proto",
    )
    max_body_kib: int = Field(
        256, ge=16, le=1_048_576, description="largest request that is neither an upload nor a bulk run, KiB"
    )
    max_bulk_body_mib: int = Field(16, ge=1, le=1024, description="largest request for a bulk run, MiB")
    reads_per_minute: int = Field(
        12_000,
        ge=0,
        description="largest number of read requests of one owner (without keys: of one address) per minute; 0: "
        "unlimited",
    )
    submissions_per_minute: int = Field(
        3_000,
        ge=0,
        description="largest number of uploads and submitted jobs of one owner per minute; 0: unlimited",
    )
    upload_mib_per_minute: int = Field(
        16_384, ge=0, description="largest size of the uploads of one owner per minute, MiB; 0: unlimited"
    )
    requests_per_caller: int = Field(
        128,
        ge=1,
        description="largest number of requests of one owner that one server answers at a time, event streams included",
    )
    streams_per_caller: int = Field(
        32,
        ge=1,
        description="largest number of event streams that one owner may have open on one server at a time",
    )
    stream_s: float = Field(
        3600.0, gt=0, description="longest duration of an event stream, s; then the client must connect again"
    )
    max_job_memory_mib: int = Field(
        default_factory=lambda checked: _memory_of_a_job_mib(checked.get("worker_processes", 1)),
        ge=1,
        description="largest estimated memory of a job, MiB; a job that needs more is refused; default: 80 % of the "
        "memory of the machine (or of its container) / worker_processes",
    )
    max_job_s: float = Field(
        172_800.0,
        gt=0,
        description="longest time of a job, s; a job with a longer estimate is refused, and an attempt that takes "
        "longer is stopped",
    )

    gap_effects: str = Field(
        "",
        description="modules or .py files, separated by commas, that define further effects for gap diagnoses; their "
        "code is executed",
    )

    @field_validator("worker_queues")
    @classmethod
    def _known_queues(cls, names: str) -> str:
        queues_named(names)
        return names

    @field_validator("trusted_proxies")
    @classmethod
    def _addresses(cls, proxies: str) -> str:
        for name in _named(proxies):
            try:
                ip_network(name)
            except ValueError as error:
                raise ValueError(
                    f"expected IP addresses or networks, separated by commas; {error}"
                ) from error
        return proxies

    @classmethod
    def apart(cls, data_dir: Path, *, gap_effects: str = "") -> Settings:
        """Default settings with this data folder. These settings ignore the environment, so that the process cannot
        touch a running service.
        """
        return cls(_env_prefix="HELIOPSF_APART_", data_dir=data_dir, gap_effects=gap_effects)

    @property
    def added_effects(self) -> tuple[str, ...]:
        """Modules or files with effects that a diagnosis tests in addition to the effects of the library."""
        return _named(self.gap_effects)

    @property
    def kept_days(self) -> dict[tuple[str, str], int]:
        """For how many days things are kept, by owner and kind; the owner "" stands for all others."""
        rules = (rule.partition("=") for rule in _named(self.keep_days))
        return {(name.rpartition("/")[0], name.rpartition("/")[2]): int(days) for name, _, days in rules}

    @property
    def host_names(self) -> tuple[str, ...]:
        """The host names that the operator allows, in lower case."""
        return _named(self.allowed_hosts.lower())

    @property
    def proxies(self) -> tuple[str, ...]:
        """The reverse proxies that the operator trusts."""
        return _named(self.trusted_proxies)

    @property
    def queues(self) -> tuple[Queue, ...]:
        """The queues that a worker serves, highest priority first."""
        return queues_named(self.worker_queues)

    @property
    def embedded(self) -> bool:
        """True if the broker is a folder; ``heliopsf serve`` then starts the worker itself."""
        return self.broker_url == EMBEDDED_BROKER

    @property
    def catalogue_url(self) -> str:
        """URL of the database; by default SQLite in the data folder."""
        if self.database_url is None:
            return f"sqlite:///{self.data_dir.resolve() / 'catalogue.sqlite'}"
        # SQLAlchemy would use psycopg2 for postgresql://, but the project installs psycopg 3.
        return self.database_url.replace("postgresql://", "postgresql+psycopg://", 1)

    @property
    def threads(self) -> int:
        """Threads of one worker process; default: cores divided by worker processes, so that the processes share the
        machine.
        """
        return self.worker_threads or max(1, cores() // self.worker_processes)

    @property
    def gone_s(self) -> float:
        """Longest time from SIGTERM to the exit of a worker, even if its job is not finished, s.

        It is longer than ``stop_s``: a worker checks only at each heartbeat whether it must hand back its job, and then
        Celery needs a few seconds to end.
        """
        return self.stop_s + self.heartbeat_s + 6.0

    @property
    def silent_s(self) -> float:
        """Time without a heartbeat after which a worker process is ended and replaced, s.

        The lease of its job has expired before.
        """
        return 2 * self.lease_s + self.cancel_s

    @property
    def presence_s(self) -> float:
        """Interval at which a worker announces itself, s. This interval is shorter than the lease."""
        return max(self.heartbeat_s, self.lease_s / 3)

    @property
    def max_upload_bytes(self) -> int:
        """Largest uploaded image, bytes."""
        return self.max_upload_mib * 2**20

    @property
    def max_psf_bytes(self) -> int:
        """Largest uploaded PSF file, bytes."""
        return self.max_psf_mib * 2**20

    @property
    def image_limits(self) -> FitsLimits:
        """Limits on the FITS files of images."""
        return FitsLimits(max_pixels=self.max_pixels)

    @property
    def psf_limits(self) -> FitsLimits:
        """Limits on the FITS files of PSFs."""
        return FitsLimits(max_pixels=self.max_psf_pixels)

    @property
    def max_transit_bytes(self) -> int:
        """Largest uploaded transit, bytes."""
        return self.max_transit_mib * 2**20

    @property
    def archive_limits(self) -> ArchiveLimits:
        """Limits on the unpacked size of a transit's archive."""
        return ArchiveLimits(max_bytes=self.max_transit_unpacked_mib * 2**20)


def _memory_of_a_job_mib(worker_processes: int) -> int:
    """The memory that one job may need if every process of a worker runs a job of this size on this machine, MiB."""
    return max(1, int(MEMORY_OF_JOBS * memory_bytes() / worker_processes) // 2**20)


def _named(names: str) -> tuple[str, ...]:
    """The names in a list that is separated by commas."""
    return tuple(name.strip() for name in names.split(",") if name.strip())


def library_versions() -> dict[str, str]:
    """Versions of the numerical libraries, as recorded in products."""
    return {name: version(name) for name in ("numpy", "scipy", "numba", "astropy")}
