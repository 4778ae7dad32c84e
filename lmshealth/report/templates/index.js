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
    count.textContent = `${shown} of ${rows.length} stages, ${way}`;
    all.hidden = shown === rows.length && !sorted;
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
  // Coming back from the page of a stage, the browser has filled in the fields.
  addEventListener("pageshow", () => sort(Number(order.value)));
  sort(-1);
})();
