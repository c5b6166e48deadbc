/** Errors between page and server, and functions that distinguish them. */

export class ApiError extends Error {
  /**
   * @param {number} status HTTP status; 0 if the server did not answer.
   * @param {string} kind the server's class name of the error.
   * @param {string} message for the operator.
   * @param {ErrorBody} [body] the whole answer; with status 409, `state` is the server's current state.
   */
  constructor(status, kind, message, body = {}) {
    super(message);
    this.name = "ApiError";
    this.status = status;
    this.kind = kind;
    this.body = body;
  }
}

/** The text of anything that was thrown. */
export const messageOf = (/** @type {unknown} */ error) => (error instanceof Error ? error.message : String(error));

/** True for a request that the page itself has cancelled. */
export const isAborted = (/** @type {unknown} */ error) =>
  error instanceof DOMException && error.name === "AbortError";

/**
 * True if others have changed the frame in the meantime; `body.state` is their version.
 *
 * @returns {error is StaleError}
 */
export function isStale(/** @type {unknown} */ error) {
  return (
    error instanceof ApiError &&
    error.status === 409 &&
    error.kind === "StaleRevisionError" &&
    error.body.state !== undefined
  );
}

/**
 * True if a track would get a second box in a frame; `body.track` is its id.
 *
 * @returns {error is TrackTakenError}
 */
export const isTrackTaken = (/** @type {unknown} */ error) =>
  error instanceof ApiError && error.kind === "TrackTakenError";
