/** Requests to the server: JSON in, JSON out. Every failure is an ApiError with a message for the operator. */

import { ApiError, isAborted } from "./errors.js";

/**
 * The caller gives the type of the answer, which the server's routes define (see `Api`).
 *
 * @param {EffortCounter} effort
 * @param {() => unknown} onSignedOut called with each 401.
 */
export function createApi(effort, onSignedOut) {
  /**
   * @param {string} method
   * @param {string} path
   * @param {unknown} body
   * @param {RequestOptions} options
   * @throws {ApiError} an answer that is an error, or none.
   */
  async function send(method, path, body, options) {
    /** @type {Record<string, string>} */
    const headers = { Accept: "application/json" };
    const isFile = body instanceof Blob;
    if (body !== undefined) headers["Content-Type"] = isFile ? "application/octet-stream" : "application/json";
    let response;
    try {
      const sent = isFile ? body : JSON.stringify(body);
      response = await fetch(path, { method, headers, signal: options.signal, body: sent });
    } catch (error) {
      if (isAborted(error)) throw error;
      const text =
        "The server does not respond. Saved work is safe. Check that the server is running, then try again.";
      throw new ApiError(0, "NoAnswer", text);
    }
    if (response.ok) return response;
    const answer = await readJson(response);
    if (response.status === 401) onSignedOut();
    const { kind = "HttpError", message = `The server responded with ${response.status} ${response.statusText}` } =
      answer?.error ?? {};
    throw new ApiError(response.status, kind, message, answer ?? {});
  }

  /**
   * @template T
   * @param {string} method
   * @param {string} path
   * @param {unknown} body
   * @param {RequestOptions} [options]
   * @returns {Promise<T>}
   */
  async function request(method, path, body, options = {}) {
    return readJson(await send(method, path, body, options));
  }

  return {
    /**
     * A GET of lines of JSON; `onLine` is called with each as it arrives.
     *
     * @template T
     * @param {string} path
     * @param {(line: T) => unknown} onLine
     * @param {RequestOptions} [options]
     */
    async lines(path, onLine, options = {}) {
      const response = await send("GET", path, undefined, options);
      let rest = "";
      const decoder = new TextDecoder();
      for await (const chunk of chunks(response)) {
        const parts = (rest + decoder.decode(chunk, { stream: true })).split("\n");
        rest = parts.pop() ?? "";
        for (const part of parts) onLine(JSON.parse(part));
      }
    },

    /** @type {<T>(path: string, options?: RequestOptions) => Promise<T>} */
    get: (path, options) => request("GET", path, undefined, options),

    /** JSON, or a file. @type {<T>(path: string, body?: object, options?: RequestOptions) => Promise<T>} */
    post: (path, body = {}, options = {}) => request("POST", path, body, options),

    /** @type {<T>(path: string, body: object) => Promise<T>} */
    put: (path, body) => request("PUT", path, body),

    /** @type {<T>(path: string, body: object) => Promise<T>} */
    patch: (path, body) => request("PATCH", path, body),

    del: (/** @type {string} */ path) => request("DELETE", path, undefined),

    /**
     * A POST that carries the effort since the last acknowledged change.
     *
     * @template T
     * @param {string} path
     * @param {object} body
     * @returns {Promise<T>}
     */
    async change(path, body) {
      const sent = effort.peek();
      /** @type {T} */
      const answer = await request("POST", path, { ...body, effort: sent });
      effort.acknowledge(sent);
      return answer;
    },
  };
}

/**
 * For requests of which only the newest counts: `const isNewest = begin()` before one, `isNewest()` after it.
 *
 * @returns {() => () => boolean} begin
 */
export function newest() {
  let asked = 0;
  return () => {
    const own = ++asked;
    return () => own === asked;
  };
}

/** @param {Response} response */
async function* chunks(response) {
  const reader = response.body?.getReader();
  for (let read = await reader?.read(); read?.value; read = await reader?.read()) yield read.value;
}

async function readJson(/** @type {Response} */ response) {
  if (response.status === 204) return null;
  const text = await response.text();
  try {
    return text ? JSON.parse(text) : null;
  } catch {
    return null;
  }
}

/** The path of a project's resource: projectPath("hands", "frames", 3) -> /api/projects/hands/frames/3. */
export function projectPath(/** @type {string} */ project, /** @type {...(string | number)} */ ...parts) {
  return ["/api/projects", ...[project, ...parts].map((part) => encodeURIComponent(part))].join("/");
}
