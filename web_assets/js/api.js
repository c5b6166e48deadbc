/** Requests to the server: JSON in, JSON out; everything that goes wrong is an ApiError with a message for the operator. */

export class ApiError extends Error {
  /**
   * @param {number} status HTTP status, 0 where the server did not answer.
   * @param {string} kind the server's class name of the error.
   * @param {object} body the whole answer; with 409 `state` is what is there now and `changes` what was sent.
   */
  constructor(status, kind, message, body = {}) {
    super(message);
    this.name = "ApiError";
    this.status = status;
    this.kind = kind;
    this.body = body;
  }

  /** Somebody else has changed the frame: `body.state` is theirs. */
  get isStale() {
    return this.status === 409 && this.kind === "StaleRevisionError" && Boolean(this.body.state);
  }
}

/**
 * @param {object} effort see effort.js.
 * @param {() => void} onSignedOut called with each 401.
 */
export function createApi(effort, onSignedOut) {
  async function request(method, path, body, options = {}) {
    const init = { method, headers: { Accept: "application/json" }, credentials: "same-origin", signal: options.signal };
    if (body !== undefined) {
      init.headers["Content-Type"] = "application/json";
      init.body = JSON.stringify(body);
    }
    let response;
    try {
      response = await fetch(path, init);
    } catch (error) {
      if (error.name === "AbortError") throw error;
      throw new ApiError(0, "NoAnswer", "The server does not answer. What was saved is safe; try again when it is back.");
    }
    const answer = await readJson(response);
    if (response.ok) return answer;
    if (response.status === 401) onSignedOut();
    const { kind = "HttpError", message = `The server answered ${response.status} ${response.statusText}` } = answer?.error ?? {};
    throw new ApiError(response.status, kind, message, answer ?? {});
  }

  return {
    get: (path, options) => request("GET", path, undefined, options),
    post: (path, body = {}, options = {}) => request("POST", path, body, options),
    put: (path, body = {}, options = {}) => request("PUT", path, body, options),
    patch: (path, body = {}, options = {}) => request("PATCH", path, body, options),
    del: (path, options = {}) => request("DELETE", path, undefined, options),

    /** A POST that carries the effort since the last acknowledged change. */
    async change(path, body, options = {}) {
      const sent = effort.peek();
      const answer = await request("POST", path, { ...body, effort: sent }, options);
      effort.acknowledge(sent);
      return answer;
    },
  };
}

async function readJson(response) {
  if (response.status === 204) return null;
  const text = await response.text();
  try {
    return text ? JSON.parse(text) : null;
  } catch {
    return null;
  }
}

/** The path of a project's resource: projectPath("hands", "frames", 3) -> /api/projects/hands/frames/3. */
export function projectPath(project, ...parts) {
  return ["/api/projects", ...[project, ...parts].map((part) => encodeURIComponent(part))].join("/");
}
