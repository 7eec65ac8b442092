"""What Prometheus reads from ``/metrics``."""

from __future__ import annotations

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    generate_latest,
)

SIZES = (1, 2, 4, 8, 16, 32, 64, 128)
SECONDS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 30)


class Metrics:
    """The counts of one server.

    Attributes:
        sessions: open sessions.
        waiting: requests in the queue.
        frames: video frames that were sent.
        refused: messages that were answered with a sentence.
        batches: requests per forward pass.
        latency: seconds from a message to its answer.
    """

    def __init__(self) -> None:
        self._all = own = CollectorRegistry()
        self.sessions = Gauge("acwm_sessions", "Open sessions", registry=own)
        self.waiting = Gauge("acwm_waiting_requests", "Requests in the queue", registry=own)
        self.frames = Counter("acwm_frames", "Video frames that were sent", registry=own)
        self.refused = Counter("acwm_refused", "Messages answered with a sentence", registry=own)
        self.batches = Histogram(
            "acwm_batch_size", "Requests per forward pass", buckets=SIZES, registry=own
        )
        self.latency = Histogram(
            "acwm_latency_seconds", "From a message to its answer", buckets=SECONDS, registry=own
        )
        ProcessCollector(registry=own)

    def text(self) -> bytes:
        """All of them, in the format of Prometheus."""
        return generate_latest(self._all)
