"""The command `report`: a result as one page for the browser."""

from shapepose_fg.cli.options import ResultOptions, grouped


@grouped
def report(result: ResultOptions) -> None:
    """Write report.html anew: one page, to be opened in a browser, with the people in 3D and how good they are."""
    from shapepose_fg.viz.report.writing import report_of

    print(report_of(result.results, body=result.body, **result.how()))
