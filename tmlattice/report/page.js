"use strict";
(() => {
  const style = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const phone = () => matchMedia("(max-width: 36rem)").matches;
  const dark = matchMedia("(prefers-color-scheme: dark)");

  function themed(text) {
    const figure = JSON.parse(text.replaceAll(/"@(\w+)"/g, (_, name) => `"${style(`--${name}`)}"`));
    if (figure.strip) {
      for (const trace of JSON.parse(document.getElementById("strip").textContent)) figure.data.push({ ...trace, yaxis: figure.strip });
    }
    const layout = Object.assign(figure.layout, {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: style("--ink"), size: phone() ? 11 : 13, family: "system-ui, sans-serif" },
      hoverlabel: { bgcolor: style("--card"), font: { color: style("--ink") }, bordercolor: style("--faint") },
    });
    for (const key of Object.keys(layout)) {
      if (/^[xy]axis/.test(key)) Object.assign(layout[key], { gridcolor: style("--line"), linecolor: style("--faint") });
    }
    return figure;
  }

  function draw() {
    for (const place of document.querySelectorAll(".figure")) {
      const figure = themed(document.getElementById(place.dataset.figure).textContent);
      Plotly.react(place, figure.data, figure.layout, {
        responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
      });
      place.parentElement.classList.add("drawn");
    }
  }

  function sortable(table) {
    const body = table.tBodies[0];
    const heads = [...table.tHead.rows[0].cells];
    heads.forEach((head, column) => head.firstElementChild.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") !== "descending";
      heads.forEach(other => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const key = row => row.cells[column].textContent;
      const compare = column === 0
        ? (a, b) => key(b).localeCompare(key(a), undefined, { numeric: true })
        : (a, b) => (key(b) === "" ? -Infinity : +key(b)) - (key(a) === "" ? -Infinity : +key(a)) || 0;
      const empty = row => column > 0 && key(row) === "";
      body.append(...[...body.rows].sort((a, b) => empty(a) - empty(b) || (down ? 1 : -1) * compare(a, b)));
    }));
  }

  function copied(text) {
    const area = document.createElement("textarea");  // works from a file, where the clipboard's own interface may not
    area.value = text;
    document.body.append(area);
    area.select();
    const done = document.execCommand("copy");
    area.remove();
    return done;
  }

  function csv(table) {
    const quoted = text => /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
    return [...table.rows].map(row => [...row.cells].map(cell => quoted(cell.textContent.trim())).join(",")).join("\n") + "\n";
  }

  for (const head of document.querySelectorAll("h2[id]")) {
    const link = document.createElement("a");
    link.href = `#${head.id}`;
    link.textContent = head.textContent;
    document.querySelector("nav").append(link);
  }
  document.querySelectorAll("table.sortable").forEach(sortable);
  for (const button of document.querySelectorAll("button.copy")) {
    button.addEventListener("click", () => {
      const done = copied(csv(document.getElementById(button.dataset.table)));
      button.textContent = done ? "copied" : "could not be copied";
    });
  }
  draw();
  dark.addEventListener("change", draw);
})();
