// Requests of a page to its server: JSON in, JSON out, with the mark of the page. A refusal is the service's own sentence.

const csrf = document.querySelector('meta[name="palpd-csrf"]').content;
const NO_LINK = "the page does not reach palpd; look at the cell, and use the emergency stop if anything moves that should not";

/** Send a request. Resolves to the answer: {ok: true, ...} or {ok: false, error: sentence}, with `unreached` where the service has not spoken; it never rejects. */
export async function ask(path, content = {}, { patience_ms = 8000 } = {}) {
  try {
    const answer = await fetch(path, {
      method: "POST",
      headers: { "Content-Type": "application/json", "X-Palpd-Csrf": csrf },
      body: JSON.stringify(content),
      cache: "no-store",
      signal: AbortSignal.timeout(patience_ms),
    });
    return await answer.json();
  } catch {
    return { ok: false, error: NO_LINK, unreached: true };
  }
}

/** Read something with GET. Resolves as `ask`. */
export async function read(path, { patience_ms = 8000 } = {}) {
  try {
    const answer = await fetch(path, { cache: "no-store", signal: AbortSignal.timeout(patience_ms) });
    return await answer.json();
  } catch {
    return { ok: false, error: NO_LINK, unreached: true };
  }
}
