"""Version 3: the labels table holds the batch run of each proposed label, so that its event need not be read."""

from __future__ import annotations

_RUN = "ALTER TABLE labels ADD COLUMN run_id INTEGER REFERENCES runs (id)"
_FILL = """
UPDATE labels SET run_id = (
    SELECT json_extract(events.payload, '$.run') FROM events WHERE events.id = labels.proposal_event_id
)
WHERE proposal_event_id IS NOT NULL
"""

STATEMENTS = (_RUN, _FILL)
