// The way to the page's own server: the key for the link's token, and requests that carry it.

const KEY = "tvsbayes-key";

/** The key of this tab: kept over a reload, else given for the token behind the #. */
export async function keyOf() {
  const token = location.hash.slice(1);
  if (token) {
    history.replaceState(null, "", "/");
    const answer = await fetch("/key", { method: "POST", body: JSON.stringify({ token }) });
    if (!answer.ok) throw new Error(await answer.text());
    sessionStorage.setItem(KEY, (await answer.json()).key);
  }
  return sessionStorage.getItem(KEY) ?? "";
}

/** An answer of the page's own server; `how` as of fetch. */
export async function asked(path, key, how = {}) {
  const answer = await fetch(path, { ...how, headers: { "X-Tvsbayes-Key": key } });
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}
