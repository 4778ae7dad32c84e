"use strict";
// Find, filter and sort the rows of a table that is complete without it.
(() => {
  const by = (id) => document.getElementById(id);
  const table = document.querySelector(".fleet");
  const [find, before, order, all, count] = ["find", "before", "order", "all", "count"].map(by);
  const states = [...document.querySelectorAll("[name=state]")];
  const heads = [...table.tHead.rows[0].cells];
  const names = heads.map((head) => head.textContent.trim());
  const alphabet = new Intl.Collator("en", { numeric: true });
  const plain = (text) => text.normalize("NFKD").replace(/\p{M}/gu, "").toLowerCase();
  const rows = [...table.tBodies[0].rows].map((line) => ({
    line,
    text: plain(`${line.cells[0].textContent} ${line.cells[1].textContent}`),
    keys: [...line.cells].map((cell, k) => {
      const key = cell.dataset.key ?? cell.querySelector("a, .mark")?.textContent ?? "";
      return key && heads[k].dataset.kind === "number" ? Number(key.replace("inf", "Infinity")) : key;
    }),
  }));

  const filter = () => {
    const words = plain(find.value).split(/\s+/).filter(Boolean);
    const state = states.find((one) => one.checked).value;
    let shown = 0;
    for (const { line, text } of rows) {
      const { due } = line.dataset;
      const fits = (!state || line.dataset.state === state) && (!before.value || (due && due < before.value))
        && words.every((word) => text.includes(word));
      line.hidden = !fits;
      shown += fits;
    }
    const sorted = table.querySelector("[aria-sort]");
    const way = sorted ? `by ${names[heads.indexOf(sorted)].toLowerCase()}, ${sorted.ariaSort}` : "most urgent first";
    count.textContent = `${shown} of ${rows.length} stage${rows.length === 1 ? "" : "s"}, ${way}`;
    all.hidden = shown === rows.length && !sorted;
    // The address keeps what is shown: it survives a reload, and can be sent.
    const kept = { find: find.value, state, before: before.value };
    if (sorted) kept.order = `${sorted.ariaSort === "descending" ? "-" : ""}${order.value}`;
    const fragment = new URLSearchParams(Object.entries(kept).filter(([, value]) => value)).toString();
    if (fragment !== location.hash.slice(1)) history.replaceState(null, "", `#${fragment}`);
  };

  const compare = (a, b) => (typeof a === "number" ? a - b || 0 : alphabet.compare(a, b));
  const sort = (column, down = false) => {
    for (const [k, head] of heads.entries()) {
      if (k === column) head.setAttribute("aria-sort", down ? "descending" : "ascending");
      else head.removeAttribute("aria-sort");
    }
    const lines = [...rows];
    if (column >= 0) {
      const missing = (row) => row.keys[column] === "";
      lines.sort((a, b) => missing(a) - missing(b)
        || (missing(a) ? 0 : (down ? -1 : 1) * compare(a.keys[column], b.keys[column])));
    }
    table.tBodies[0].append(...lines.map((row) => row.line));
    order.value = String(column);
    filter();
  };

  const wrap = (cell, action) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...cell.childNodes);
    button.addEventListener("click", action);
    cell.append(button);
  };

  order.append(new Option("Most urgent first", "-1"), ...names.map((name, k) => new Option(name, String(k))));
  // A third press restores the order of urgency.
  heads.forEach((head, k) => wrap(head, () => {
    if (head.ariaSort === "descending") sort(-1);
    else sort(k, head.ariaSort === "ascending");
  }));
  for (const month of document.querySelectorAll("[data-before]")) {
    wrap(month, () => { before.value = month.dataset.before; filter(); by("stages").scrollIntoView(); });
  }
  for (const input of [find, before, ...states]) input.addEventListener("input", filter);
  order.addEventListener("change", () => sort(Number(order.value)));
  all.addEventListener("click", () => {
    find.value = before.value = "";
    states[0].checked = true;
    sort(-1);
    find.focus();
  });
  document.querySelector(".tools").hidden = false;
  const restore = () => {
    const kept = new URLSearchParams(location.hash.slice(1));
    find.value = kept.get("find") ?? "";
    before.value = kept.get("before") ?? "";
    (states.find((one) => one.value === kept.get("state")) ?? states[0]).checked = true;
    const by_column = kept.get("order") ?? "";
    const column = Math.abs(Number(by_column));
    if (by_column && column < heads.length) sort(column, by_column.startsWith("-"));
    else sort(-1);
  };
  // The browser fills in fields after this script, and an address may be changed by hand.
  for (const event of ["pageshow", "hashchange"]) addEventListener(event, restore);
  restore();
})();
