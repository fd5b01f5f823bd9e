for (const table of document.querySelectorAll('table.sorts')) {
  const heads = [...table.tHead.rows[0].cells], body = table.tBodies[0];
  heads.forEach((head, k) => head.firstElementChild.addEventListener('click', () => {
    const down = head.getAttribute('aria-sort') === 'ascending', sign = down ? -1 : 1;
    heads.forEach(other => other.removeAttribute('aria-sort'));
    head.setAttribute('aria-sort', down ? 'descending' : 'ascending');
    const of = row => row.cells[k].dataset.value ?? row.cells[k].textContent;
    const number = head.classList.contains('n');
    const order = (a, b) => {
      const [x, y] = [of(a), of(b)];
      if (x === '' || y === '') return (x === '') - (y === '');
      return sign * (number ? x - y : x.localeCompare(y));
    };
    body.append(...[...body.rows].sort(order));
  }));
}
