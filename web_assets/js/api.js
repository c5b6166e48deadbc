/** Requests to the server: JSON in, JSON out. Every failure is an ApiError with a message for the operator. */

import { ApiError, isAborted } from "./errors.js";

/**
 * The types of answers are those of the server's routes (`Api.Answers`).
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
   * @param {string} method
   * @param {string} path
   * @param {unknown} body
   * @param {RequestOptions} [options]
   * @returns {Promise<any>} of the type that the server's schema gives to the route (`Answer`).
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

    /** @type {Ask<"GET">} */
    get: (path, options) => request("GET", path, undefined, options),

    /** JSON, or a file. @type {Send<"POST">} */
    post: (path, body = {}, options = {}) => request("POST", path, body, options),

    /** @type {Send<"PUT">} */
    put: (path, body) => request("PUT", path, body),

    /** @type {Send<"PATCH">} */
    patch: (path, body) => request("PATCH", path, body),

    /** @type {Ask<"DELETE">} */
    del: (path) => request("DELETE", path, undefined),

    /** A POST that carries the effort since the last acknowledged change. @type {Send<"POST">} */
    async change(path, body) {
      const sent = effort.peek();
      const answer = await request("POST", path, { ...body, effort: sent });
      effort.acknowledge(sent);
      return answer;
    },
  };
}

/**
 * A path with a query.
 *
 * @template {string} P
 * @param {P} path
 * @param {Record<string, string>} query
 */
export const withQuery = (path, query) => /** @type {P} */ (`${path}?${new URLSearchParams(query)}`);

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

/**
 * The path of a project's resource: projectPath("hands", "frames", 3) -> /api/projects/hands/frames/3.
 *
 * @template {readonly (string | number)[]} const P
 * @param {string} project
 * @param {P} parts
 */
export function projectPath(project, ...parts) {
  const path = ["/api/projects", ...[project, ...parts].map((part) => encodeURIComponent(part))].join("/");
  return /** @type {ProjectPath<P>} */ (path);
}
