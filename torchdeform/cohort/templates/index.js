const body = document.getElementById("pairs").tBodies[0], filter = document.getElementById("filter");
const buttons = [...document.querySelectorAll(".counts button")], headers = [...document.querySelectorAll("th")];
const key = (row, k) => k === 1 ? row.cells[1].textContent.trim() : row.cells[k].dataset.value ?? "";
const compare = (a, b) => {
  if (a === "" || b === "") return (a === "") - (b === "");
  const difference = a - b;
  return Number.isNaN(difference) ? a.localeCompare(b, undefined, {numeric: true}) : difference;
};
headers.forEach((header, k) => header.querySelector("button")?.addEventListener("click", () => {
  const down = header.ariaSort === "ascending";
  headers.forEach(other => other.removeAttribute("aria-sort"));
  header.setAttribute("aria-sort", down ? "descending" : "ascending");
  const rows = [...body.rows].map(row => [key(row, k), row]).sort(([x], [y]) =>
    x === "" || y === "" ? compare(x, y) : (down ? -1 : 1) * compare(x, y));
  body.append(...rows.map(([, row]) => row));
}));
const show = () => {
  const wanted = filter.value.toLowerCase();
  const kind = buttons.find(button => button.ariaPressed === "true").dataset.kind;
  let count = 0;
  for (const row of body.rows) {
    row.hidden = (kind && row.className !== kind) || !row.textContent.toLowerCase().includes(wanted);
    count += !row.hidden;
  }
  document.getElementById("shown").textContent = count < body.rows.length ? `${count} of ${body.rows.length} pairs` : "";
};
filter.addEventListener("input", show);
buttons.forEach(button => button.addEventListener("click", () => {
  buttons.forEach(other => other.setAttribute("aria-pressed", other === button));
  show();
}));
