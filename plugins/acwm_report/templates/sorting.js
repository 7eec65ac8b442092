// Headings of sortable tables sort by their column, first the smaller, then the larger, gaps last.
for (const table of document.querySelectorAll("table[data-sortable]")) {
  const body = table.tBodies[0];
  const heads = [...table.tHead.rows[table.tHead.rows.length - 1].cells];
  const key = (row, index) => {
    const cell = row.cells[index];
    const text = cell.firstChild ? cell.firstChild.textContent.trim() : "";
    const number = cell.dataset.value ?? (/^[0-9]+$/.test(text) ? text : "");
    return { gap: text === "" || text === "–", number: number === "" ? null : Number(number), text };
  };
  const compare = (a, b) =>
    a.number !== null && b.number !== null ? a.number - b.number : a.text.localeCompare(b.text);
  heads.forEach((head, index) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const rows = [...body.rows].map((row) => ({ row, key: key(row, index) }));
      rows.sort((a, b) => a.key.gap - b.key.gap || (down ? -1 : 1) * compare(a.key, b.key));
      body.append(...rows.map(({ row }) => row));
    });
  });
}
