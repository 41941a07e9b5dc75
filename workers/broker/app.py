"""The broker: a Celery application, and the submission of job ids to it.

The broker may lose messages or deliver them twice: lost jobs are submitted again from the job table, and a second
delivery has no effect. Therefore messages need not be durable. Jobs are submitted by the name of the Celery task,
because the web process must not import tasks.
"""

from __future__ import annotations

import logging

from celery import Celery
from kombu import Connection
from kombu import Queue as BrokerQueue
from kombu.exceptions import KombuError, OperationalError
from kombu.transport import redis
from redis.exceptions import RedisError, ResponseError

from workers.contract.jobs import Queue, broker_name
from workers.settings import Settings

RUN_JOB = "heliopsf.run_job"
ASSIST = "heliopsf.assist"
PROCESS_START_S = (
    120.0  # on a busy machine; Celery's default of 4 s would end every new process again and again
)
AWAY = (OperationalError, KombuError, RedisError, OSError)
REFUSED = ResponseError  # one of AWAY: Redis answers, but accepts no messages
NO_MESSAGE = "no message is like this one"
log = logging.getLogger(__name__)


def make_app(settings: Settings) -> Celery:
    """Make a Celery application for these settings, and the folders of the embedded broker if it is used."""
    app = Celery("heliopsf", broker=settings.broker_url, set_as_current=False)
    app.conf.update(
        task_serializer="json",
        accept_content=["json"],
        task_ignore_result=True,
        # Acknowledge early: the job table decides which jobs have to run, and a worker with unacknowledged messages
        # crashes when it loses its broker (kombu 5.7).
        task_acks_late=False,
        worker_prefetch_multiplier=1,
        # If a process has ended, Celery waits for the result of its job before the new process gets a job.
        # This wait is short, because our jobs have no results in Celery.
        worker_lost_wait=0.1,
        # A new process loads numba and other libraries before it reports to its parent, which ends it otherwise.
        worker_proc_alive_timeout=PROCESS_START_S,
        task_queues=[BrokerQueue(broker_name(queue), routing_key=broker_name(queue)) for queue in Queue],
        task_default_queue=broker_name(Queue.INTERACTIVE),
        broker_connection_retry_on_startup=True,
        # A Redis that refuses commands counts as lost, and PatientConsumer waits for it; by default the worker ends.
        broker_channel_error_retry=True,
        worker_consumer="workers.broker.order:PatientConsumer",
        worker_hijack_root_logger=False,
        worker_send_task_events=False,
        # Its commands need no key: whoever writes to the broker could stop the workers or make them deaf.
        worker_enable_remote_control=False,
        broker_transport="workers.broker.order:FolderTransport" if settings.embedded else None,
        broker_transport_options=_transport_options(settings),
    )
    return app


def submit(app: Celery, job_id: str, queue: Queue = Queue.INTERACTIVE) -> bool:
    """Send the id of a job to the broker. Returns False if the broker does not answer; the reconciler then tries
    again.
    """
    try:
        app.send_task(RUN_JOB, args=[job_id], queue=broker_name(queue), retry=False)
    except AWAY as error:
        log.warning("the broker does not answer, job %s stays queued: %s", job_id, error)
        return False
    return True


def call_for_help(app: Celery, job_id: str, workers: int) -> None:
    """Ask idle workers to share the work of a job. If the messages are lost, the worker that runs the job does all of
    the work.
    """
    try:
        for _ in range(workers):
            app.send_task(ASSIST, args=[job_id], queue=broker_name(Queue.CROSSVAL), retry=False)
    except AWAY as error:
        log.warning("the broker does not answer, job %s continues without help: %s", job_id, error)


def check(url: str) -> None:
    """Raise an error if the broker does not answer within seconds or accepts no messages. Not for the embedded broker.

    The error is one of ``AWAY``; for a bad URL it is the error of the transport library.
    """
    options = {"socket_connect_timeout": 2, "socket_timeout": 2}
    with Connection(url, transport_options=options, connect_timeout=2) as connection:
        connection.ensure_connection(max_retries=1, interval_start=0, timeout=3)
        channel = connection.default_channel
        if isinstance(channel, redis.Channel):
            for queue in Queue:
                # Redis refuses this command for every reason for which it refuses a message. The command inserts
                # nothing, because no message of the queue is like NO_MESSAGE.
                channel.client.linsert(broker_name(queue), "BEFORE", NO_MESSAGE, "")


def _transport_options(settings: Settings) -> dict[str, object]:
    if not settings.embedded:
        patience = {"socket_connect_timeout": 5, "socket_timeout": 10}
        return {**patience, "queue_order_strategy": "workers.broker.order:MostUrgentFirst"}
    broker = settings.data_dir.resolve() / "broker"
    queue, control = broker / "queue", broker / "control"
    for folder in (queue, control):
        folder.mkdir(parents=True, exist_ok=True)
    return {
        "data_folder_in": str(queue),
        "data_folder_out": str(queue),
        "control_folder": str(control),
        "store_processed": False,
        "polling_interval": 0.1,
    }
